//! A drawing surface of pixels for charts: everything at twice its size, text from a rasterised font.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, RasterizedChar, get_raster, get_raster_width};
use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind, rasterizer,
};

/// Pixels of the picture per unit of the chart.
pub(super) const SCALE: u32 = 2;

/// Draws nothing wrong: there is no device that could fail.
type Drawn = Result<(), DrawingErrorKind<std::convert::Infallible>>;

/// A picture of RGB bytes under construction.
pub(super) struct Canvas<'a> {
    units: (u32, u32),
    fine: Fine<'a>,
}

impl<'a> Canvas<'a> {
    /// A black canvas of `units`; `pixels` become `SCALE²` as many.
    pub(super) fn new(units: (u32, u32), pixels: &'a mut Vec<u8>) -> Self {
        let (width, height) = (units.0 * SCALE, units.1 * SCALE);
        pixels.clear();
        pixels.resize(width as usize * height as usize * 3, 0);
        Self { units, fine: Fine { width, height, pixels } }
    }
}

fn scaled((x, y): BackendCoord) -> BackendCoord {
    (x * SCALE as i32, y * SCALE as i32)
}

impl DrawingBackend for Canvas<'_> {
    type ErrorType = std::convert::Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.units
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, point: BackendCoord, color: BackendColor) -> Drawn {
        let (x, y) = scaled(point);
        let step = SCALE as i32;
        (0..step * step).try_for_each(|i| self.fine.draw_pixel((x + i % step, y + i / step), color))
    }

    fn draw_line<S: BackendStyle>(&mut self, from: BackendCoord, to: BackendCoord, style: &S) -> Drawn {
        rasterizer::draw_line(&mut self.fine, scaled(from), scaled(to), style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        upper_left: BackendCoord,
        bottom_right: BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        rasterizer::draw_rect(&mut self.fine, scaled(upper_left), scaled(bottom_right), style, fill)
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(&mut self, path: I, style: &S) -> Drawn {
        self.fine.draw_path(path.into_iter().map(scaled), style)
    }

    fn draw_circle<S: BackendStyle>(&mut self, center: BackendCoord, radius: u32, style: &S, fill: bool) -> Drawn {
        rasterizer::draw_circle(&mut self.fine, scaled(center), radius * SCALE, style, fill)
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(&mut self, vert: I, style: &S) -> Drawn {
        self.fine.fill_polygon(vert.into_iter().map(scaled), style)
    }

    fn draw_text<S: BackendTextStyle>(&mut self, text: &str, style: &S, pos: BackendCoord) -> Drawn {
        let raster = raster_of(style.size());
        let (width, height) = extent(text, raster);
        let (mut x, mut y) = scaled(pos);
        x -= match style.anchor().h_pos {
            HPos::Left => 0,
            HPos::Center => width / 2,
            HPos::Right => width,
        };
        y -= match style.anchor().v_pos {
            VPos::Top => 0,
            VPos::Center => height / 2,
            VPos::Bottom => height,
        };
        for c in text.chars() {
            // What the font lacks is a space.
            let glyph = get_raster(plain(c), FontWeight::Regular, raster);
            for (row, line) in (0..).zip(glyph.iter().flat_map(RasterizedChar::rows)) {
                for (column, &share) in (0..).zip(line) {
                    let alpha = style.color().alpha * f64::from(share) / 255.0;
                    let color = BackendColor { alpha, rgb: style.color().rgb };
                    self.fine.draw_pixel((x + column, y + row), color)?;
                }
            }
            x += get_raster_width(FontWeight::Regular, raster) as i32;
        }
        Ok(())
    }

    fn estimate_text_size<S: BackendTextStyle>(
        &self,
        text: &str,
        style: &S,
    ) -> Result<(u32, u32), DrawingErrorKind<Self::ErrorType>> {
        let (width, height) = extent(text, raster_of(style.size()));
        Ok((width as u32 / SCALE, height as u32 / SCALE))
    }
}

/// The raster for a font size in units of the chart.
fn raster_of(size: f64) -> RasterHeight {
    match size {
        s if s < 13.0 => RasterHeight::Size20,
        s if s < 16.0 => RasterHeight::Size24,
        _ => RasterHeight::Size32,
    }
}

fn extent(text: &str, raster: RasterHeight) -> (i32, i32) {
    let width = get_raster_width(FontWeight::Regular, raster) * text.chars().count();
    (width as i32, raster.val() as i32)
}

/// The nearest character that the font has.
fn plain(c: char) -> char {
    match c {
        '−' | '–' | '—' => '-',
        '→' => '>',
        c => c,
    }
}

/// The pixels themselves.
struct Fine<'a> {
    width: u32,
    height: u32,
    pixels: &'a mut Vec<u8>,
}

impl DrawingBackend for Fine<'_> {
    type ErrorType = std::convert::Infallible;

    fn get_size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, color: BackendColor) -> Drawn {
        let inside = x >= 0 && y >= 0 && x < self.width as i32 && y < self.height as i32;
        if !inside || color.alpha <= 0.0 {
            return Ok(());
        }
        let start = (y as usize * self.width as usize + x as usize) * 3;
        let (r, g, b) = color.rgb;
        for (old, new) in self.pixels[start..start + 3].iter_mut().zip([r, g, b]) {
            let mixed = f64::from(*old) + (f64::from(new) - f64::from(*old)) * color.alpha.min(1.0);
            *old = mixed.round() as u8;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use plotters::prelude::*;

    use super::*;

    fn dark_share(pixels: &[u8], width: u32, columns: std::ops::Range<u32>) -> f64 {
        let in_columns = |i: &usize| columns.contains(&(*i as u32 % width));
        let inside: Vec<usize> = (0..pixels.len() / 3).filter(in_columns).collect();
        inside.iter().filter(|&&i| pixels[3 * i] < 128).count() as f64 / inside.len() as f64
    }

    #[test]
    fn shapes_and_text_land_where_they_belong() {
        let mut pixels = Vec::new();
        {
            let root = Canvas::new((100, 20), &mut pixels).into_drawing_area();
            root.fill(&WHITE).unwrap();
            root.draw(&Rectangle::new([(0, 0), (9, 19)], BLACK.filled())).unwrap();
            root.draw(&Text::new("MMMM", (40, 4), ("sans-serif", 11).into_font())).unwrap();
            // Outside: nothing happens.
            root.draw(&Text::new("M", (400, 4), ("sans-serif", 11).into_font())).unwrap();
        }
        assert_eq!(pixels.len(), 200 * 40 * 3);
        assert!(dark_share(&pixels, 200, 0..19) > 0.9);
        assert_eq!(dark_share(&pixels, 200, 22..78), 0.0);
        assert!((0.05..0.6).contains(&dark_share(&pixels, 200, 80..124)));
        assert_eq!(dark_share(&pixels, 200, 140..200), 0.0);
    }
}

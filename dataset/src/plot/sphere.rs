//! Where the cameras stand on the sphere around the head.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{Chart, text};
use crate::views::{self, Coverage};

const SIDE: u32 = 460;
const HEADER: u32 = 64;
/// Steps of the graticule, degrees.
const STEP: i32 = 15;

/// The hemisphere in front of the face, seen from the front: grey dots are usable frames, coloured ones chosen. The
/// picture's right is the image's right of the face.
#[derive(Clone, Debug)]
pub struct Sphere {
    /// Yaw and pitch of the usable frames, degrees.
    pub usable: Vec<[f64; 2]>,
    /// The same of those chosen for fitting.
    pub train: Vec<[f64; 2]>,
    /// The same of those held out.
    pub val: Vec<[f64; 2]>,
    /// The numbers.
    pub coverage: Coverage,
}

impl Chart for Sphere {
    fn size(&self) -> (u32, u32) {
        (SIDE + 24, SIDE + HEADER + 12)
    }

    fn draw<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>) -> Result<(), String> {
        let c = &self.coverage;
        let title = format!(
            "Cameras around the head: yaw {:.0}° to {:.0}°, pitch {:.0}° to {:.0}°",
            c.yaw_deg[0], c.yaw_deg[1], c.pitch_deg[0], c.pitch_deg[1]
        );
        text(root, &title, (12, 10), 15)?;
        let second = format!(
            "{} of {} cells of {:.0}° covered; largest gap {:.1}°. Lines every {STEP}°.",
            c.cells_chosen,
            c.cells,
            views::CELL_DEG,
            c.largest_gap_deg
        );
        text(root, &second, (12, 30), 12)?;
        text(root, "Grey: usable. Blue: chosen for fitting. Orange: held out.", (12, 46), 12)?;
        let (middle, radius) = ((SIDE as i32 / 2 + 12, (HEADER + SIDE / 2) as i32), f64::from(SIDE) / 2.0 - 4.0);
        let place = |view: [f64; 2]| {
            let d = views::direction_of(view);
            // Views from behind stand at the rim.
            let out = if d.z > 0.0 { 1.0 / d.truncate().length().max(1e-9) } else { 1.0 };
            (middle.0 + (d.x * out * radius).round() as i32, middle.1 + (d.y * out * radius).round() as i32)
        };
        graticule(root, &place)?;
        let classes = [
            (&self.usable, RGBColor(190, 190, 190), 1),
            (&self.train, RGBColor(0, 114, 178), 2),
            (&self.val, RGBColor(230, 159, 0), 3),
        ];
        for (list, colour, size) in classes {
            // A dot per pixel is enough: thousands of frames stand on the same spot.
            let spots: std::collections::BTreeSet<(i32, i32)> = list.iter().map(|&v| place(v)).collect();
            let dots = spots.into_iter().map(|p| Circle::new(p, size, colour.filled()));
            dots.into_iter().try_for_each(|dot| root.draw(&dot)).map_err(|e| e.to_string())?;
        }
        Ok(())
    }
}

fn graticule<DB: DrawingBackend>(
    root: &DrawingArea<DB, Shift>,
    place: &impl Fn([f64; 2]) -> (i32, i32),
) -> Result<(), String> {
    let grey = RGBColor(222, 222, 222);
    let dark = RGBColor(150, 150, 150);
    for line in -90 / STEP..=90 / STEP {
        let angle = f64::from(line * STEP);
        let along = || (-30..=30).map(|t| f64::from(t) * 3.0);
        let style = if line == 0 || line.abs() == 90 / STEP { dark } else { grey };
        let meridian: Vec<_> = along().map(|t| place([angle, t])).collect();
        let parallel: Vec<_> = along().map(|t| place([t, angle])).collect();
        for path in [meridian, parallel] {
            root.draw(&PathElement::new(path, style)).map_err(|e| e.to_string())?;
        }
    }
    Ok(())
}

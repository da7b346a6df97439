//! Picture after picture of one avatar, each drawn anew only where it differs from the one before.

use glam::DVec2;
use image::RgbImage;
use risorius_brick::Skips;
use risorius_brick::render::{BakedFace, BakedPicture, Face, FacePicture, Shown};
use risorius_formats::{Camera, Reporter};

use crate::avatar::{Avatar, Render, Wanted};
use crate::cutout;
use crate::error::Result;

/// How pictures are taken.
#[derive(Clone, Copy, Debug, Default)]
pub struct Look {
    /// What the brick field leaves out.
    pub skips: Skips,
    /// Whether the brick field is baked: faster by far when the camera moves, with a small error, and without masks.
    pub baked: bool,
    /// Whether views finer than the fitted images are rendered pixel by pixel, rather than enlarged.
    pub full: bool,
    /// Whether renders hold the head alone besides: colours and opacity, with several rays per pixel on its edges.
    pub cutout: bool,
}

/// A camera at work.
pub struct Studio<'a> {
    avatar: &'a Avatar,
    look: Look,
    last: Option<Last<'a>>,
    baked: Option<(BakedFace<'a>, Vec<f32>)>,
}

/// The picture before, of one camera.
struct Last<'a> {
    camera: Camera,
    wanted: Vec<Wanted>,
    picture: Picture<'a>,
    /// What is behind everything.
    backdrop: RgbImage,
    /// What was handed out.
    render: Render,
}

enum Picture<'a> {
    Direct { face: Face<'a>, picture: FacePicture },
    Baked(BakedPicture),
}

impl Picture<'_> {
    /// What each ray shows.
    fn shown(&self) -> &[Shown] {
        match self {
            Self::Direct { picture, .. } => &picture.shown,
            Self::Baked(picture) => &picture.shown,
        }
    }
}

impl<'a> Studio<'a> {
    /// An empty studio.
    pub fn new(avatar: &'a Avatar, look: Look) -> Self {
        Self { avatar, look, last: None, baked: None }
    }

    /// The picture of `camera`, rendered no finer than the images that were fitted and enlarged to the asked size (the
    /// field holds no detail beyond them, and every skipped pixel is time saved), unless the look is `full`; with the render
    /// behind it, which may be smaller.
    pub fn picture_and_maps(
        &mut self,
        camera: &Camera,
        attributes: &[f32],
        reporter: &dyn Reporter,
    ) -> Result<(RgbImage, Render)> {
        let reduce = if self.look.full { 1 } else { self.avatar.spare_resolution(camera) };
        let render = self.render(&camera.reduced(reduce), attributes, reporter)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let picture = if render.rgb.dimensions() == (width, height) {
            render.rgb.clone()
        } else {
            image::imageops::resize(&render.rgb, width, height, image::imageops::FilterType::CatmullRom)
        };
        Ok((picture, render))
    }

    /// Renders `camera` with the attributes (K of them), every pixel.
    pub fn render(&mut self, camera: &Camera, attributes: &[f32], reporter: &dyn Reporter) -> Result<Render> {
        if let Some(picture) = self.avatar.render_networks(camera, attributes, self.look.cutout, reporter)? {
            return Ok(picture);
        }
        self.draw(camera, attributes);
        if self.look.cutout {
            self.cut_out();
        }
        let regions = self.avatar.saved.table.regions.len();
        Ok(self.last.as_ref().map_or_else(|| Render::empty(camera, regions), |last| last.render.clone()))
    }

    /// Brings `last` up to date.
    fn draw(&mut self, camera: &Camera, attributes: &[f32]) {
        let Some((model, plate)) = self.avatar.brick() else { return };
        let origin = camera.center().as_vec3().to_array();
        if self.look.baked {
            if let Some((face, wears)) = &mut self.baked {
                if wears != attributes {
                    face.edit(attributes);
                    attributes.clone_into(wears);
                }
            } else {
                // Colours are those seen from where the head was seen at rest.
                let eye = Camera::from(&self.avatar.saved.default_camera).center().as_vec3().to_array();
                self.baked = Some((BakedFace::new(model, attributes, eye), attributes.to_vec()));
            }
        }
        let same_camera = self.last.as_ref().is_some_and(|l| l.camera == *camera);
        if let Some(last) = self.last.as_mut().filter(|_| same_camera) {
            let changed = match (&mut last.picture, &mut self.baked) {
                (Picture::Baked(picture), Some((face, _))) => face.redraw(picture),
                (Picture::Direct { face, picture }, _) => {
                    let changed = face.edit(attributes);
                    face.redraw(picture, changed)
                }
                (Picture::Baked(_), None) => Vec::new(),
            };
            last.paint(changed);
            return;
        }
        let wanted = self.avatar.wanted(camera);
        let directions: Vec<[f32; 3]> = wanted.iter().map(|(_, d)| d.to_array()).collect();
        let picture = if let Some((face, _)) = &mut self.baked {
            Picture::Baked(face.picture(origin, directions))
        } else {
            // What a face keeps for its expression, and a picture's memory, serve again.
            let kept = self.last.take().and_then(|last| match last.picture {
                Picture::Direct { face, picture } => Some((face, picture)),
                Picture::Baked(_) => None,
            });
            let (face, picture) = if let Some((mut face, mut picture)) = kept {
                face.edit(attributes);
                face.take_again(&mut picture, origin, directions);
                (face, picture)
            } else {
                let mut face = Face::new(model, attributes);
                face.skips = self.look.skips;
                let picture = face.picture(origin, directions);
                (face, picture)
            };
            Picture::Direct { face, picture }
        };
        let mut render = Render::empty(camera, self.avatar.saved.table.regions.len());
        if let Some(plate) = plate {
            plate.paint(&mut render.rgb);
        }
        let backdrop = render.rgb.clone();
        let mut last = Last { camera: *camera, wanted, picture, backdrop, render };
        last.paint(0..last.wanted.len());
        self.last = Some(last);
    }

    /// Fills `head` of the last render: from its rays, and from more of them on the edges.
    fn cut_out(&mut self) {
        let Some(last) = &mut self.last else { return };
        let Last { camera, wanted, picture, render, .. } = last;
        let (width, origin) = (camera.intrinsics.width as usize, camera.center().as_vec3().to_array());
        let shown = picture.shown();
        render.head.clear();
        render.head.resize(render.depth.len(), [0.0; 4]);
        for ((pixel, _), shown) in wanted.iter().zip(shown) {
            render.head[*pixel] = shown.head;
        }
        let edges = cutout::edges(&render.head, width);
        let mut rays = Vec::new();
        let mut directions = Vec::new();
        for pixel in edges {
            let middle = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            let places = cutout::ON_EDGES.map(|offset| camera.ray_direction(middle + DVec2::from_array(offset)));
            if let [Some(a), Some(b), Some(c), Some(d)] = places {
                rays.push(pixel);
                directions.extend([a, b, c, d].map(|d| d.as_vec3().to_array()));
            }
        }
        let shown = match (&mut *picture, &mut self.baked) {
            (Picture::Direct { face, .. }, _) => face.render(origin, &directions),
            (Picture::Baked(_), Some((face, _))) => face.picture(origin, directions).shown,
            (Picture::Baked(_), None) => return,
        };
        for (pixel, shown) in rays.into_iter().zip(shown.as_chunks::<{ cutout::ON_EDGES.len() }>().0) {
            render.head[pixel] = cutout::mean(&shown.map(|s| s.head));
        }
    }
}

impl Last<'_> {
    /// Puts what these rays show into the picture.
    fn paint(&mut self, rays: impl IntoIterator<Item = usize>) {
        let Self { wanted, picture, backdrop, render, .. } = self;
        let shown = picture.shown();
        for ray in rays {
            let (pixel, shown) = (wanted[ray].0, &shown[ray]);
            let behind = &backdrop.as_raw()[pixel * 3..pixel * 3 + 3];
            let bytes = render.rgb.as_mut()[pixel * 3..pixel * 3 + 3].iter_mut();
            for ((byte, color), behind) in bytes.zip(shown.color).zip(behind) {
                let value = color + shown.left * f32::from(*behind) / 255.0;
                *byte = (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            }
            render.depth[pixel] = shown.depth;
            for (mask, value) in render.masks.iter_mut().zip(shown.masks) {
                mask[pixel] = value;
            }
        }
    }
}

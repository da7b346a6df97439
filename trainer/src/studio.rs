//! Picture after picture of one avatar, each drawn anew only where it differs from the one before.

use image::RgbImage;
use risorius_brick::Skips;
use risorius_brick::render::{BakedFace, BakedPicture, Face, Shown};
use risorius_formats::{Camera, Reporter};

use crate::avatar::{Avatar, Render, Wanted};
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
    directions: Vec<[f32; 3]>,
    picture: Picture<'a>,
}

enum Picture<'a> {
    Direct { face: Face<'a>, shown: Vec<Shown> },
    Baked(BakedPicture),
}

impl<'a> Studio<'a> {
    /// An empty studio.
    pub fn new(avatar: &'a Avatar, look: Look) -> Self {
        Self { avatar, look, last: None, baked: None }
    }

    /// The picture of `camera`, rendered no finer than the images that were fitted and enlarged to the asked size (the
    /// field holds no detail beyond them, and every skipped pixel is time saved), unless the look is `full`.
    pub fn picture(&mut self, camera: &Camera, attributes: &[f32], reporter: &dyn Reporter) -> Result<RgbImage> {
        Ok(self.picture_and_maps(camera, attributes, reporter)?.0)
    }

    /// As [`Self::picture`], with the render behind it, which may be smaller.
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
        if let Some(picture) = self.avatar.render_networks(camera, attributes, reporter)? {
            return Ok(picture);
        }
        self.draw(camera, attributes);
        let mut picture = Render::empty(camera, self.avatar.saved.table.regions.len());
        if let Some((_, Some(plate))) = self.avatar.brick() {
            plate.paint(&mut picture.rgb);
        }
        if let Some(last) = &self.last {
            let shown = match &last.picture {
                Picture::Direct { shown, .. } => shown,
                Picture::Baked(baked) => &baked.shown,
            };
            paint(&last.wanted, shown, &mut picture);
        }
        Ok(picture)
    }

    /// Brings `last` up to date.
    fn draw(&mut self, camera: &Camera, attributes: &[f32]) {
        let Some((model, _)) = self.avatar.brick() else { return };
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
        match (&mut self.last, &mut self.baked) {
            (Some(last), baked) if same_camera => match (&mut last.picture, baked) {
                (Picture::Baked(picture), Some((face, _))) => {
                    face.redraw(picture);
                }
                (Picture::Direct { face, shown }, _) => {
                    let changed = face.edit(attributes);
                    face.redraw(origin, &last.directions, shown, changed);
                }
                (Picture::Baked(_), None) => {}
            },
            (last, baked) => {
                let wanted = self.avatar.wanted(camera);
                let directions: Vec<[f32; 3]> = wanted.iter().map(|(_, d)| d.to_array()).collect();
                let picture = if let Some((face, _)) = baked {
                    Picture::Baked(face.picture(origin, directions.clone()))
                } else {
                    let mut face = Face::new(model, attributes);
                    face.skips = self.look.skips;
                    let shown = face.render(origin, &directions);
                    Picture::Direct { face, shown }
                };
                *last = Some(Last { camera: *camera, wanted, directions, picture });
            }
        }
    }
}

/// The brick field's rays, over what the picture already shows.
fn paint(wanted: &[Wanted], shown: &[Shown], picture: &mut Render) {
    for ((pixel, _), shown) in wanted.iter().zip(shown) {
        for (byte, color) in picture.rgb.as_mut()[pixel * 3..pixel * 3 + 3].iter_mut().zip(shown.color) {
            let value = color + shown.left * f32::from(*byte) / 255.0;
            *byte = (value.clamp(0.0, 1.0) * 255.0).round() as u8;
        }
        picture.depth[*pixel] = shown.depth;
        for (mask, value) in picture.masks.iter_mut().zip(shown.masks) {
            mask[*pixel] = value;
        }
    }
}

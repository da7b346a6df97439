//! Picture after picture of one avatar, each drawn anew only where it differs from the one before.

use image::RgbImage;
use risorius_formats::{Camera, Reporter};

use crate::avatar::Avatar;
use crate::error::Result;
use crate::expression::Expression;
use crate::field::{FieldRenderer, Look, Outputs, Render};

/// A camera at work.
pub struct Studio<'a> {
    avatar: &'a Avatar,
    look: Look,
    renderer: Box<dyn FieldRenderer + 'a>,
}

impl<'a> Studio<'a> {
    /// An empty studio.
    pub fn new(avatar: &'a Avatar, look: Look) -> Self {
        Self { avatar, look, renderer: avatar.field.renderer(look.skips) }
    }

    /// Changes what renders hold from now on.
    pub fn set_outputs(&mut self, outputs: Outputs) {
        self.look.outputs = outputs;
    }

    /// The picture of `camera`, with the render behind it. A field whose pixels are dear renders no finer than the images
    /// that were fitted, and the picture is enlarged to the asked size (the field holds no detail beyond them), unless the
    /// look is `full`; the render is then smaller than the picture.
    pub fn picture_and_maps(
        &mut self,
        camera: &Camera,
        expression: &Expression,
        reporter: &dyn Reporter,
    ) -> Result<(RgbImage, Render)> {
        let reduce = if self.look.full { 1 } else { self.avatar.spare_resolution(camera) };
        let render = self.render(&camera.reduced(reduce), expression, reporter)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let picture = if render.rgb.dimensions() == (width, height) {
            render.rgb.clone()
        } else {
            image::imageops::resize(&render.rgb, width, height, image::imageops::FilterType::CatmullRom)
        };
        Ok((picture, render))
    }

    /// Renders `camera` with an expression, every pixel.
    pub fn render(&mut self, camera: &Camera, expression: &Expression, reporter: &dyn Reporter) -> Result<Render> {
        self.renderer.render(camera, expression, self.look.outputs, reporter)
    }
}

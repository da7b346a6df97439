//! An opened avatar of Gaussians, and its pictures.

use std::path::Path;

use glam::DVec2;
use rayon::prelude::*;
use risorius_formats::{AuScale, Camera, Intrinsics, Isometry, Reporter};
use risorius_splat::{Gaussians, MOST_SIDE, Picture, Renderer, Skips};

use super::plate::Plate;
use super::space::MetricSpace;
use super::store::{self, SavedSplat};
use crate::error::{Result, TrainerError};
use crate::expression::Expression;
use crate::field::{Field, FieldRenderer, Outputs, Render};
use crate::saved::SavedModel;

/// A pixel belongs to the head where the head's opacity is at least this.
const HEAD: f32 = 0.5;

/// A fitted avatar of Gaussians.
pub struct SplatField {
    /// The Gaussians.
    pub model: Gaussians,
    saved: SavedSplat,
    plate: Option<Plate>,
    scales: Vec<AuScale>,
}

impl SplatField {
    /// Reads the Gaussians of a run.
    pub fn open(saved: &SavedModel, splat: &SavedSplat, run: &Path) -> Result<Self> {
        let (model, plate) = store::read(&run.join("model.safetensors"), splat)?;
        let scales = saved.table.attributes.iter().map(AuScale::new).collect();
        Ok(Self { model, saved: splat.clone(), plate, scales })
    }

    /// The Gaussians' space.
    pub fn space(&self) -> &MetricSpace {
        &self.saved.space
    }

    /// The picture behind a head before a still camera, if there is one.
    pub fn plate(&self) -> Option<&Plate> {
        self.plate.as_ref()
    }

    /// Whether intensities were fitted, rather than attributes, which end at 80 % of the strongest.
    pub fn knows_intensities(&self) -> bool {
        self.saved.intensities
    }

    /// The activations of an expression.
    pub fn activations(&self, expression: &Expression) -> Vec<f32> {
        let of = |(scale, intensity): (&AuScale, &_)| {
            if self.saved.intensities {
                scale.activation(*intensity)
            } else {
                scale.activation_from_attribute(scale.attribute(*intensity))
            }
        };
        self.scales.iter().zip(&expression.0).map(|pair| of(pair).0).collect()
    }
}

impl Field for SplatField {
    fn renderer(&self, skips: Skips) -> Box<dyn FieldRenderer + '_> {
        let renderer = Renderer::new(&self.model, skips);
        Box::new(SplatRenderer { field: self, renderer, backdrop: None, lengths: None })
    }

    fn is_dear(&self) -> bool {
        false
    }

    fn gaussians(&self) -> Option<&SplatField> {
        Some(self)
    }

    fn regions_of(&self, au: usize, own: usize) -> Vec<usize> {
        let layout = &self.model.layout;
        let reach = layout.reach(au);
        std::iter::once(own).chain((0..layout.regions).filter(|&r| r != own && reach >> r & 1 != 0)).collect()
    }
}

struct SplatRenderer<'a> {
    field: &'a SplatField,
    renderer: Renderer<'a>,
    /// The plate at the size of the last picture.
    backdrop: Option<((u32, u32), Vec<u8>)>,
    /// For the last lens, how much longer each pixel's ray is than its depth along the axis.
    lengths: Option<(Intrinsics, Vec<f32>)>,
}

impl FieldRenderer for SplatRenderer<'_> {
    fn render(
        &mut self,
        camera: &Camera,
        expression: &Expression,
        outputs: Outputs,
        reporter: &dyn Reporter,
    ) -> Result<Render> {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: "part of a picture".to_owned() });
        }
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if width.max(height) as usize > MOST_SIDE {
            return Err(TrainerError::Setting {
                message: format!("a picture of {width}×{height} pixels"),
                hint: format!("the Gaussian field draws up to {MOST_SIDE} pixels along a side"),
            });
        }
        self.fit_backdrop((camera.intrinsics.width, camera.intrinsics.height));
        if outputs.depth {
            self.measure_rays(&camera.intrinsics);
        }
        let field = self.field;
        let wanted = risorius_splat::Outputs {
            depth: outputs.depth,
            masks: outputs.masks,
            // Depth is the head's, which its opacity tells.
            head: outputs.head || outputs.depth,
        };
        let picture = self.renderer.draw(
            &field.saved.space.camera(camera),
            &Isometry::IDENTITY,
            &field.activations(expression),
            self.backdrop.as_ref().map(|(_, rgb)| rgb.as_slice()),
            wanted,
        );
        let lengths = self.lengths.as_ref().map_or(&[][..], |(_, lengths)| lengths);
        Ok(self.field.render_of(picture, camera, outputs, lengths))
    }
}

impl SplatRenderer<'_> {
    fn fit_backdrop(&mut self, size: (u32, u32)) {
        let Some(plate) = &self.field.plate else { return };
        if self.backdrop.as_ref().is_none_or(|(before, _)| *before != size) {
            self.backdrop = Some((size, plate.resized(size.0, size.1)));
        }
    }

    fn measure_rays(&mut self, lens: &Intrinsics) {
        if self.lengths.as_ref().is_none_or(|(before, _)| before != lens) {
            self.lengths = Some((*lens, ray_lengths(lens)));
        }
    }
}

impl SplatField {
    /// A picture of the kernels in the trainer's terms.
    fn render_of(&self, picture: &Picture, camera: &Camera, outputs: Outputs, lengths: &[f32]) -> Render {
        let mut render = Render::empty(camera, self.saved.layout.regions, outputs);
        copy(&picture.rgb, render.rgb.as_mut());
        if outputs.depth {
            let units_per_metre = self.saved.space.metres_per_unit.recip() as f32;
            for (i, out) in render.depth.iter_mut().enumerate() {
                let is_head = picture.head.get(i).is_some_and(|h| h[3] >= HEAD);
                if let (Some(depth), Some(length), true) = (picture.depth.get(i), lengths.get(i), is_head) {
                    *out = depth * length * units_per_metre;
                }
            }
        }
        if outputs.masks {
            render.masks.iter_mut().zip(&picture.masks).for_each(|(out, mask)| copy(mask, out));
        }
        if outputs.head {
            copy(&picture.head, &mut render.head);
        }
        render
    }
}

/// Copies as much as both hold.
fn copy<T: Copy>(from: &[T], to: &mut [T]) {
    let count = from.len().min(to.len());
    to[..count].copy_from_slice(&from[..count]);
}

/// Length of each pixel's ray per unit of depth along the axis; 0 beyond the fold of a lens.
fn ray_lengths(lens: &Intrinsics) -> Vec<f32> {
    let (width, height) = (lens.width as usize, lens.height as usize);
    let length = |i: usize| {
        let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        lens.unproject(pixel).map_or(0.0, |p| p.extend(1.0).length() as f32)
    };
    (0..width * height).into_par_iter().map(length).collect()
}

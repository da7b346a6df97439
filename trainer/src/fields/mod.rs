//! The networks of the field, one module per file, named as in the paper.

mod ambient;
mod attribute;
mod deformation;
mod mask;
mod template;
mod uncertainty;

pub use ambient::{AmbientSlices, Slices};
pub use attribute::AttributeNet;
pub use deformation::DeformationField;
pub use mask::MaskNets;
pub use template::{Template, TemplateOutput};
pub use uncertainty::{BETA_FLOOR, UncertaintyNets};

//! Where Gaussians begin: depth maps by plane sweep, AU motion from landmarks, or the face's shape alone.

use risorius_formats::Isometry;

/// A Gaussian to begin with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seed {
    /// Where, metres, head and room at rest.
    pub mean: [f32; 3],
    /// Unit normal of the surface it lies in.
    pub normal: [f32; 3],
    /// Colour, 0–1.
    pub color: [f32; 3],
    /// Standard deviation in the surface, metres.
    pub sigma: f32,
    /// Standard deviation across it, metres.
    pub thickness: f32,
    /// Opacity, 0–1.
    pub opacity: f32,
    /// Share of the frames with masks in which it projects onto each region.
    pub regions: [f32; crate::model::REGIONS],
    /// How much of the head's motion it follows, 0–1.
    pub head_weight: f32,
    /// Whether it may carry deltas (it lies in the face).
    pub deformable: bool,
}

/// The motion of the 68 landmarks: X_l(a) = rest_l + Σ_k a_k deltas_kl, metres in the head frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LandmarkMotion {
    /// Positions without any AU.
    pub rest: [[f64; 3]; 68],
    /// Per AU, the displacement of each landmark at activation 1.
    pub deltas: Vec<[[f64; 3]; 68]>,
    /// RMS of the reprojection error, pixels.
    pub error_px: f64,
}

/// All that a fit begins with.
#[derive(Clone, Debug, PartialEq)]
pub struct Start {
    /// The Gaussians.
    pub seeds: Vec<Seed>,
    /// The landmarks' motion, where frames have landmarks and AUs.
    pub motion: Option<LandmarkMotion>,
    /// Head pose per frame (`room_from_head`): the frames' own, or estimated from landmarks where the head sways.
    pub head_poses: Vec<Isometry>,
}

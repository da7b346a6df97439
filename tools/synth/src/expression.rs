//! Expressions: AU intensities, and what they do to brows, lids and mouth.

use risorius_formats::ActionUnit;
use risorius_formats::au::{MAX_INTENSITY, OPENFACE_INTENSITIES};

/// The intensities of the 17 AUs that the model knows, 0–5. The default is the neutral face.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expression {
    intensities: [f32; 17],
}

impl Expression {
    /// All intensities at 0.
    pub const NEUTRAL: Self = Self { intensities: [0.0; 17] };

    /// From pairs; AUs that the model does not know are left out.
    pub fn of(pairs: &[(u8, f32)]) -> Self {
        pairs.iter().fold(Self::NEUTRAL, |e, &(unit, value)| e.with(ActionUnit(unit), value))
    }

    /// The same with one intensity changed; limited to 0–5.
    #[must_use]
    pub fn with(mut self, unit: ActionUnit, intensity: f32) -> Self {
        if let Some(i) = OPENFACE_INTENSITIES.iter().position(|&u| u == unit) {
            self.intensities[i] = intensity.clamp(0.0, MAX_INTENSITY);
        }
        self
    }

    /// Intensity 0–5; 0 for an AU that the model does not know.
    pub fn intensity(&self, unit: ActionUnit) -> f32 {
        OPENFACE_INTENSITIES.iter().position(|&u| u == unit).map_or(0.0, |i| self.intensities[i])
    }

    /// All intensities in the order of an OpenFace table.
    pub fn intensities(&self) -> &[f32; 17] {
        &self.intensities
    }

    /// Strength 0..1 of the AU with this number.
    pub(crate) fn strength(&self, unit: u8) -> f32 {
        self.intensity(ActionUnit(unit)) / MAX_INTENSITY
    }
}

/// A lid opening in the plane of the face, for the eye on the subject's left; metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lids {
    /// Height of the upper edge over the line between the corners, in the middle.
    pub(crate) upper: f32,
    /// Depth of the lower edge under that line.
    pub(crate) lower: f32,
}

impl Lids {
    /// x, y of the middle between the corners.
    pub(crate) const CENTRE: [f32; 2] = [0.0315, 0.0175];
    /// From the middle to a corner.
    pub(crate) const HALF_WIDTH: f32 = 0.0150;

    /// Upper and lower edge at `u`, −1 (inner corner) to 1 (outer corner).
    pub(crate) fn edges(self, u: f32) -> [f32; 2] {
        let u = u.clamp(-1.0, 1.0);
        let line = Self::CENTRE[1] + 0.0011 * u;
        let arch = 1.0 - u * u;
        [line + self.upper * arch.powf(0.72) * (1.0 - 0.12 * u), line - self.lower * arch * (1.0 + 0.15 * u)]
    }

    fn of(e: &Expression) -> Self {
        let lower = 0.0044 - 0.0028 * e.strength(7) - 0.0013 * e.strength(6);
        let open = 0.0060 + 0.0036 * e.strength(5) - 0.0014 * e.strength(7) - 0.0005 * e.strength(6);
        // Closed, the upper edge lies on the lower one and a hair below.
        let shut = e.strength(45);
        Self { upper: open + (-(lower + 0.0012) - open) * shut, lower }
    }
}

/// The mouth in the plane of the face, metres. `t` runs from −1 to 1 between the corners.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mouth {
    /// x, y of the corner on the subject's left.
    pub(crate) corner: [f32; 2],
    /// Height of the seam in the middle.
    pub(crate) seam: f32,
    /// How far the upper lip's inner edge lies above the seam.
    pub(crate) open_up: f32,
    /// How far the lower lip's inner edge lies below the seam.
    pub(crate) open_down: f32,
    /// Thickness of the upper lip.
    pub(crate) upper_lip: f32,
    /// Thickness of the lower lip.
    pub(crate) lower_lip: f32,
}

impl Mouth {
    /// Height of the neutral mouth.
    pub(crate) const HEIGHT: f32 = -0.0545;

    fn of(e: &Expression) -> Self {
        let s = |unit| e.strength(unit);
        let tight = 1.0 - 0.7 * s(23);
        let corner = [
            0.0240 + 0.0090 * s(12) + 0.0085 * s(20) + 0.0025 * s(14)
                - 0.0045 * s(23)
                - 0.0020 * s(26)
                - 0.0015 * s(17),
            Self::HEIGHT + 0.0100 * s(12) - 0.0085 * s(15) - 0.0010 * s(20) + 0.0010 * s(14) - 0.0030 * s(26),
        ];
        Self {
            corner,
            seam: Self::HEIGHT - 0.0012 * s(12) + 0.0035 * s(17) + 0.0010 * s(15),
            open_up: (0.0020 * s(25) + 0.0042 * s(10) + 0.0015 * s(26)) * tight,
            open_down: (0.0050 * s(25) + 0.0110 * s(26)) * tight * (1.0 - 0.6 * s(17)),
            upper_lip: 0.0070 * (1.0 - 0.35 * s(12) - 0.22 * s(20) - 0.15 * s(10)) * (1.0 - 0.62 * s(23)),
            lower_lip: 0.0088 * (1.0 - 0.25 * s(12) - 0.20 * s(20) + 0.10 * s(17)) * (1.0 - 0.60 * s(23)),
        }
    }

    /// Heights of the four lip lines at `t`, from the top: upper outer, upper inner, lower inner, lower outer.
    pub(crate) fn lines(&self, t: f32) -> [f32; 4] {
        let t = t.clamp(-1.0, 1.0);
        let arch = 1.0 - t * t;
        let bow = arch.powf(0.7) * (1.0 - 0.20 * (-(t / 0.16) * (t / 0.16)).exp());
        let gap = arch.powf(0.8);
        let seam = self.seam + (self.corner[1] - self.seam) * (t * t);
        let [upper_inner, lower_inner] = [seam + self.open_up * gap, seam - self.open_down * gap];
        [upper_inner + self.upper_lip * bow, upper_inner, lower_inner, lower_inner - self.lower_lip * arch.powf(0.6)]
    }
}

/// The brows in the plane of the face, for the subject's left, metres. `s` runs from 0 (inner end) to 1 (outer end).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Brow {
    inner_up: f32,
    outer_up: f32,
    lower: f32,
}

impl Brow {
    fn of(e: &Expression) -> Self {
        Self { inner_up: 0.0085 * e.strength(1), outer_up: 0.0085 * e.strength(2), lower: e.strength(4) }
    }

    /// x of the inner and outer end.
    pub(crate) fn ends(&self) -> [f32; 2] {
        [0.0125 - 0.0040 * self.lower, 0.0555 - 0.0015 * self.lower]
    }

    /// How far the brow stands above its place at rest, at `s`.
    pub(crate) fn lift(&self, s: f32) -> f32 {
        let inner = (1.0 - s) * (1.0 - s);
        self.inner_up * inner + self.outer_up * crate::noise::step(0.20, 0.85, s) - self.lower * (0.0058 - 0.0036 * s)
    }

    /// Height of the middle line at `s`.
    pub(crate) fn height(&self, s: f32) -> f32 {
        let arch = 2.0 * (s - 0.60);
        0.0490 - 0.0034 * arch * arch + self.lift(s)
    }

    /// Half of the brow's thickness at `s`.
    pub(crate) fn half_thickness(s: f32) -> f32 {
        0.0040 * (1.0 - 0.55 * s * s) * crate::noise::step(-0.06, 0.14, s)
    }
}

/// Everything that an expression changes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FaceState {
    pub(crate) expression: Expression,
    pub(crate) lids: Lids,
    pub(crate) mouth: Mouth,
    pub(crate) brow: Brow,
}

impl FaceState {
    pub(crate) fn of(expression: &Expression) -> Self {
        Self {
            expression: *expression,
            lids: Lids::of(expression),
            mouth: Mouth::of(expression),
            brow: Brow::of(expression),
        }
    }

    /// Strength 0..1 of an AU.
    pub(crate) fn strength(&self, unit: u8) -> f32 {
        self.expression.strength(unit)
    }
}

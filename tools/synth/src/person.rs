//! Who is seen: the proportions and colours that tell one head from another.

use glam::Vec3;

/// Proportions and colours of a person. Lengths are metres, colours linear RGB in 0..1.
#[derive(Clone, Debug, PartialEq)]
pub struct Person {
    /// Stretches the whole head along x, y and z; 1 is the standard head.
    pub proportions: Vec3,
    /// Width of the jaw, 1 is the standard.
    pub jaw_width: f32,
    /// Size of the nose, 1 is the standard.
    pub nose_size: f32,
    /// How far the hair stands off the skull.
    pub hair_thickness: f32,
    /// Skin.
    pub skin: Vec3,
    /// Lips.
    pub lips: Vec3,
    /// Iris.
    pub iris: Vec3,
    /// Hair and brows.
    pub hair: Vec3,
    /// The shirt's two colours.
    pub shirt: [Vec3; 2],
    /// How many of the possible freckles are there, 0..1.
    pub freckles: f32,
    /// Drives the grain of skin, hair and cloth.
    pub seed: u32,
}

/// An 8-bit sRGB colour as linear RGB.
pub(crate) fn srgb(r: u8, g: u8, b: u8) -> Vec3 {
    let linear = |c: u8| {
        let c = f32::from(c) / 255.0;
        if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    };
    Vec3::new(linear(r), linear(g), linear(b))
}

impl Person {
    /// The person of the capture.
    pub fn subject(seed: u32) -> Self {
        Self {
            proportions: Vec3::ONE,
            jaw_width: 1.0,
            nose_size: 1.0,
            hair_thickness: 0.012,
            skin: srgb(236, 188, 160),
            lips: srgb(196, 96, 94),
            iris: srgb(74, 118, 128),
            hair: srgb(92, 56, 36),
            shirt: [srgb(38, 84, 124), srgb(226, 220, 200)],
            freckles: 0.55,
            seed,
        }
    }

    /// Somebody else, whose expressions drive the subject's avatar.
    pub fn driver(seed: u32) -> Self {
        Self {
            proportions: Vec3::new(1.04, 0.96, 1.02),
            jaw_width: 1.16,
            nose_size: 1.14,
            hair_thickness: 0.006,
            skin: srgb(164, 112, 82),
            lips: srgb(146, 78, 72),
            iris: srgb(78, 50, 30),
            hair: srgb(28, 24, 24),
            shirt: [srgb(176, 70, 52), srgb(240, 190, 92)],
            freckles: 0.12,
            seed: seed ^ 0x00d1_71e5,
        }
    }
}

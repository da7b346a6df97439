//! Numbers of 64, 32 and 16 bits behind one name. Each operation is rounded to the type.

use half::{bf16, f16};

/// What the stages compute with.
pub(crate) trait Number: Copy {
    /// The nearest number.
    fn of(value: f64) -> Self;
    /// The number.
    fn value(self) -> f64;
    /// a + b
    fn plus(self, b: Self) -> Self;
    /// a · b
    fn times(self, b: Self) -> Self;
    /// −a
    fn negated(self) -> Self;
    /// e^a
    fn exp(self) -> Self;
    /// sin a, cos a
    fn sin_cos(self) -> [Self; 2];
}

macro_rules! native {
    ($($t:ty),*) => {$(
        impl Number for $t {
            fn of(value: f64) -> Self {
                value as $t
            }
            fn value(self) -> f64 {
                f64::from(self)
            }
            fn plus(self, b: Self) -> Self {
                self + b
            }
            fn times(self, b: Self) -> Self {
                self * b
            }
            fn negated(self) -> Self {
                -self
            }
            fn exp(self) -> Self {
                self.exp()
            }
            fn sin_cos(self) -> [Self; 2] {
                self.sin_cos().into()
            }
        }
    )*};
}

macro_rules! emulated {
    ($($t:ty),*) => {$(
        impl Number for $t {
            fn of(value: f64) -> Self {
                Self::from_f64(value)
            }
            fn value(self) -> f64 {
                self.to_f64()
            }
            fn plus(self, b: Self) -> Self {
                Self::from_f32(self.to_f32() + b.to_f32())
            }
            fn times(self, b: Self) -> Self {
                Self::from_f32(self.to_f32() * b.to_f32())
            }
            fn negated(self) -> Self {
                -self
            }
            fn exp(self) -> Self {
                Self::from_f32(self.to_f32().exp())
            }
            fn sin_cos(self) -> [Self; 2] {
                let (sin, cos) = self.to_f32().sin_cos();
                [Self::from_f32(sin), Self::from_f32(cos)]
            }
        }
    )*};
}

native!(f64, f32);
emulated!(bf16, f16);

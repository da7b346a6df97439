//! The element types the kernels work on.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Mul, Neg, Sub};

use burn::tensor::{Shape, TensorData};
use burn_flex::FlexTensor;

/// A floating-point element: `f32` for training, `f64` for gradient checks.
pub(crate) trait Scalar:
    Copy
    + Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + 'static
{
    /// Zero.
    const ZERO: Self;
    /// One.
    const ONE: Self;

    /// Nearest value of this type.
    fn from_f64(value: f64) -> Self;

    /// e to the power of `self`.
    fn exp(self) -> Self;

    /// Sines and cosines of `scale * x`, element by element; the three slices have one length.
    fn sin_cos_scaled(x: &[Self], scale: Self, sin: &mut [Self], cos: &mut [Self]);

    /// Elements of a contiguous tensor.
    fn view(tensor: &FlexTensor) -> &[Self];

    /// Tensor that owns `values`.
    fn tensor(values: Vec<Self>, shape: Shape) -> FlexTensor {
        FlexTensor::from_data(Self::data(values, shape))
    }

    /// Data that owns `values`.
    fn data(values: Vec<Self>, shape: Shape) -> TensorData;
}

macro_rules! scalar {
    ($float:ty, $sin_cos:path) => {
        impl Scalar for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;

            fn from_f64(value: f64) -> Self {
                value as $float
            }

            fn exp(self) -> Self {
                <$float>::exp(self)
            }

            fn sin_cos_scaled(x: &[Self], scale: Self, sin: &mut [Self], cos: &mut [Self]) {
                $sin_cos(x, scale, sin, cos);
            }

            fn view(tensor: &FlexTensor) -> &[Self] {
                match tensor.as_slice() {
                    Some(values) => values,
                    None => panic!("tensor of {:?} is not contiguous or not of this type", tensor.dtype()),
                }
            }

            fn data(values: Vec<Self>, shape: Shape) -> TensorData {
                TensorData::new(values, shape)
            }
        }
    };
}

scalar!(f32, super::sincos::f32_scaled);
scalar!(f64, super::sincos::f64_scaled);

/// The tensor itself if contiguous, else a contiguous copy.
pub(crate) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.is_contiguous() { tensor } else { tensor.to_contiguous() }
}

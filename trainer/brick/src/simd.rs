//! Vectors of 16 and of 4 numbers for whatever instructions the machine has, found at run time.
//!
//! A kernel is a [`Task`] whose body is generic over [`Simd`]; [`run`] compiles it once per instruction set and picks the
//! widest one the machine supports. `RISORIUS_SIMD=scalar|avx2|avx512` narrows the choice, for tests and measurements.
#![allow(unsafe_code, reason = "vector instructions behind one small border; every caller is checked in debug builds")]
#![allow(
    clippy::missing_safety_doc,
    reason = "all operations: the instruction set must be present, pointers must be valid"
)]

use std::sync::OnceLock;

/// The operations that the kernels are made of.
pub trait Simd: Copy + 'static {
    /// 16 numbers.
    type V: Copy;
    /// 4 numbers.
    type Q: Copy;
    /// Rows and vectors that a block of a matrix product keeps in registers.
    const ROWS: usize;

    /// 16 times `x`.
    unsafe fn splat(x: f32) -> Self::V;
    /// 16 numbers from `p`.
    unsafe fn load(p: *const f32) -> Self::V;
    /// 16 numbers to `p`.
    unsafe fn store(p: *mut f32, v: Self::V);
    /// a · b + c
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// a + b
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    /// max(a, 0)
    unsafe fn relu(a: Self::V) -> Self::V;
    /// `a` where `gate` > 0, else 0.
    unsafe fn where_positive(gate: Self::V, a: Self::V) -> Self::V;

    /// 4 times `x`.
    unsafe fn q_splat(x: f32) -> Self::Q;
    /// 4 numbers from `p`.
    unsafe fn q_load(p: *const f32) -> Self::Q;
    /// 4 numbers to `p`.
    unsafe fn q_store(p: *mut f32, v: Self::Q);
    /// a · b + c
    unsafe fn q_fma(a: Self::Q, b: Self::Q, c: Self::Q) -> Self::Q;
    /// Σ a · b
    unsafe fn q_dot(a: Self::Q, b: Self::Q) -> f32;
}

/// A kernel.
pub trait Task {
    /// What it gives back.
    type Output;
    /// The body. Mark it `#[inline(always)]`, or it is not compiled for the instruction set.
    fn run<S: Simd>(self) -> Self::Output;
}

/// Instruction sets, narrow to wide.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// No assumption.
    Scalar,
    /// AVX2 with FMA.
    Avx2,
    /// AVX-512 F, VL, DQ and BW.
    Avx512,
}

/// The widest set the machine has (or `RISORIUS_SIMD` allows).
pub fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(|| {
        let allowed = match std::env::var("RISORIUS_SIMD").as_deref() {
            Ok("scalar") => Level::Scalar,
            Ok("avx2") => Level::Avx2,
            _ => Level::Avx512,
        };
        detected().min(allowed)
    })
}

#[cfg(target_arch = "x86_64")]
fn detected() -> Level {
    let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let avx512 = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512bw");
    if avx2 && avx512 {
        Level::Avx512
    } else if avx2 {
        Level::Avx2
    } else {
        Level::Scalar
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn detected() -> Level {
    Level::Scalar
}

/// Runs a kernel with the widest instructions.
#[inline]
pub fn run<T: Task>(task: T) -> T::Output {
    run_at(level(), task)
}

/// Runs a kernel with the instructions of `level`, which the machine must have.
#[inline]
pub fn run_at<T: Task>(level: Level, task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
        unsafe fn avx512<T: Task>(task: T) -> T::Output {
            task.run::<x86::Avx512>()
        }
        #[target_feature(enable = "avx2,fma")]
        unsafe fn avx2<T: Task>(task: T) -> T::Output {
            task.run::<x86::Avx2>()
        }
        // SAFETY: `level` never exceeds what the machine was found to have.
        match level.min(detected()) {
            Level::Avx512 => return unsafe { avx512(task) },
            Level::Avx2 => return unsafe { avx2(task) },
            Level::Scalar => {}
        }
    }
    let _ = level;
    task.run::<Scalar>()
}

/// Plain Rust.
#[derive(Clone, Copy, Debug)]
pub struct Scalar;

impl Simd for Scalar {
    type V = [f32; 16];
    type Q = [f32; 4];
    const ROWS: usize = 2;

    #[inline(always)]
    unsafe fn splat(x: f32) -> [f32; 16] {
        [x; 16]
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> [f32; 16] {
        unsafe { p.cast::<[f32; 16]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: [f32; 16]) {
        unsafe { p.cast::<[f32; 16]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn fma(a: [f32; 16], b: [f32; 16], c: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn add(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn relu(a: [f32; 16]) -> [f32; 16] {
        a.map(|x| if x > 0.0 { x } else { 0.0 })
    }
    #[inline(always)]
    unsafe fn where_positive(gate: [f32; 16], a: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| if gate[i] > 0.0 { a[i] } else { 0.0 })
    }
    #[inline(always)]
    unsafe fn q_splat(x: f32) -> [f32; 4] {
        [x; 4]
    }
    #[inline(always)]
    unsafe fn q_load(p: *const f32) -> [f32; 4] {
        unsafe { p.cast::<[f32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn q_store(p: *mut f32, v: [f32; 4]) {
        unsafe { p.cast::<[f32; 4]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn q_fma(a: [f32; 4], b: [f32; 4], c: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn q_dot(a: [f32; 4], b: [f32; 4]) -> f32 {
        (a[0] * b[0] + a[2] * b[2]) + (a[1] * b[1] + a[3] * b[3])
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    #[allow(clippy::wildcard_imports, reason = "thirty intrinsics, each named after what it does")]
    use std::arch::x86_64::*;

    use super::Simd;

    macro_rules! quads {
        () => {
            type Q = __m128;
            #[inline(always)]
            unsafe fn q_splat(x: f32) -> __m128 {
                unsafe { _mm_set1_ps(x) }
            }
            #[inline(always)]
            unsafe fn q_load(p: *const f32) -> __m128 {
                unsafe { _mm_loadu_ps(p) }
            }
            #[inline(always)]
            unsafe fn q_store(p: *mut f32, v: __m128) {
                unsafe { _mm_storeu_ps(p, v) }
            }
            #[inline(always)]
            unsafe fn q_fma(a: __m128, b: __m128, c: __m128) -> __m128 {
                unsafe { _mm_fmadd_ps(a, b, c) }
            }
            #[inline(always)]
            unsafe fn q_dot(a: __m128, b: __m128) -> f32 {
                unsafe {
                    let p = _mm_mul_ps(a, b);
                    let p = _mm_add_ps(p, _mm_movehl_ps(p, p));
                    _mm_cvtss_f32(_mm_add_ss(p, _mm_shuffle_ps::<1>(p, p)))
                }
            }
        };
    }

    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx512;

    impl Simd for Avx512 {
        type V = __m512;
        const ROWS: usize = 8;
        quads!();

        #[inline(always)]
        unsafe fn splat(x: f32) -> __m512 {
            unsafe { _mm512_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn load(p: *const f32) -> __m512 {
            unsafe { _mm512_loadu_ps(p) }
        }
        #[inline(always)]
        unsafe fn store(p: *mut f32, v: __m512) {
            unsafe { _mm512_storeu_ps(p, v) }
        }
        #[inline(always)]
        unsafe fn fma(a: __m512, b: __m512, c: __m512) -> __m512 {
            unsafe { _mm512_fmadd_ps(a, b, c) }
        }
        #[inline(always)]
        unsafe fn add(a: __m512, b: __m512) -> __m512 {
            unsafe { _mm512_add_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn relu(a: __m512) -> __m512 {
            unsafe { _mm512_max_ps(a, _mm512_setzero_ps()) }
        }
        #[inline(always)]
        unsafe fn where_positive(gate: __m512, a: __m512) -> __m512 {
            unsafe { _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate, _mm512_setzero_ps()), a) }
        }
    }

    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx2;

    impl Simd for Avx2 {
        type V = [__m256; 2];
        const ROWS: usize = 4;
        quads!();

        #[inline(always)]
        unsafe fn splat(x: f32) -> [__m256; 2] {
            unsafe { [_mm256_set1_ps(x); 2] }
        }
        #[inline(always)]
        unsafe fn load(p: *const f32) -> [__m256; 2] {
            unsafe { [_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))] }
        }
        #[inline(always)]
        unsafe fn store(p: *mut f32, v: [__m256; 2]) {
            unsafe {
                _mm256_storeu_ps(p, v[0]);
                _mm256_storeu_ps(p.add(8), v[1]);
            }
        }
        #[inline(always)]
        unsafe fn fma(a: [__m256; 2], b: [__m256; 2], c: [__m256; 2]) -> [__m256; 2] {
            unsafe { [_mm256_fmadd_ps(a[0], b[0], c[0]), _mm256_fmadd_ps(a[1], b[1], c[1])] }
        }
        #[inline(always)]
        unsafe fn add(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
            unsafe { [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])] }
        }
        #[inline(always)]
        unsafe fn relu(a: [__m256; 2]) -> [__m256; 2] {
            unsafe { a.map(|v| _mm256_max_ps(v, _mm256_setzero_ps())) }
        }
        #[inline(always)]
        unsafe fn where_positive(gate: [__m256; 2], a: [__m256; 2]) -> [__m256; 2] {
            unsafe {
                let half = |g: __m256, v: __m256| _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(g, _mm256_setzero_ps()), v);
                [half(gate[0], a[0]), half(gate[1], a[1])]
            }
        }
    }
}

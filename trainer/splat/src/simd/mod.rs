//! Vectors of 16 numbers for whatever instructions the machine has, found at run time.
//!
//! A kernel is a [`Task`] whose body is generic over [`Simd`]; [`run`] compiles it once per instruction set and picks the
//! widest one the machine supports (AVX-512, AVX2 with FMA, portable). `RISORIUS_SIMD=scalar|avx2|avx512` narrows the
//! choice, for tests and measurements. Kernels write arithmetic with [`F`], a vector with operators.
#![allow(unsafe_code, reason = "vector instructions behind one small border")]
#![allow(clippy::missing_safety_doc, reason = "all operations: the instruction set must be present, see `Simd`")]
#![allow(clippy::undocumented_unsafe_blocks, reason = "each is one instruction; what makes it sound stands at `Simd`")]

mod scalar;
mod vector;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::OnceLock;

pub use self::scalar::Scalar;
pub use self::vector::{F, M, Row, exp2, exp2_fast, greater, log2, prefetch, rows, rows_mut, sums8, test32, transpose};

/// The operations that the kernels are made of.
///
/// # Safety
/// The machine must have the instruction set: only [`run_at`] hands out a set, and never one that the machine lacks.
/// Pointers are valid for 16 (or the stated number of) items at any alignment.
pub trait Simd: Copy + Send + Sync + 'static {
    /// 16 numbers.
    type V: Copy;
    /// Which of 16.
    type M: Copy;

    /// 16 times `x`.
    unsafe fn splat(x: f32) -> Self::V;
    /// 16 numbers from `p`.
    unsafe fn load(p: *const f32) -> Self::V;
    /// 16 numbers to `p`.
    unsafe fn store(p: *mut f32, v: Self::V);
    /// a + b
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    /// a − b
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    /// a · b
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// a / b
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
    /// a · b + c
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// c − a · b
    unsafe fn fnma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The larger of both; `b` where `a` is NaN.
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    /// The smaller of both; `b` where `a` is NaN.
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V;
    /// √a
    unsafe fn sqrt(a: Self::V) -> Self::V;
    /// 1 / a to about 1e-6.
    unsafe fn reciprocal(a: Self::V) -> Self::V;
    /// 1 / a to about 1e-4.
    unsafe fn reciprocal_rough(a: Self::V) -> Self::V;
    /// The nearest whole number.
    unsafe fn round(a: Self::V) -> Self::V;
    /// The greatest whole number that is not above a.
    unsafe fn floor(a: Self::V) -> Self::V;
    /// a · 2^r of a whole number r from −126 to 127.
    unsafe fn scale2(a: Self::V, r: Self::V) -> Self::V;
    /// a − ⌊a⌋, and what [`Self::scale2`] takes for ⌊a⌋; a is at most 127, below −126 the power is 2⁻¹²⁶ or less.
    unsafe fn parts(a: Self::V) -> (Self::V, Self::V);
    /// Mantissa in 1..2 and exponent of a positive normal number.
    unsafe fn split(a: Self::V) -> (Self::V, Self::V);
    /// Where a < b.
    unsafe fn lt(a: Self::V, b: Self::V) -> Self::M;
    /// Where both.
    unsafe fn m_and(a: Self::M, b: Self::M) -> Self::M;
    /// `a` where `m`, else `b`.
    unsafe fn select(m: Self::M, a: Self::V, b: Self::V) -> Self::V;
    /// A bit each, the first the lowest.
    unsafe fn m_bits(m: Self::M) -> u16;
    /// The inverse of [`Self::m_bits`].
    unsafe fn m_from(bits: u16) -> Self::M;
    /// The sum of all 16, in a fixed order that is the same for all instruction sets.
    unsafe fn sum(a: Self::V) -> f32;
    /// The sums of eight vectors, each as by [`Self::sum`].
    unsafe fn sums8(v: &[Self::V; 8]) -> [f32; 8];
    /// Rows become columns.
    unsafe fn transpose(v: &mut [Self::V; 16]);
    /// Fetches the cache line that `p` points to; any pointer will do.
    unsafe fn prefetch(p: *const f32);
    /// A bit for each of the 32 numbers at `p` that shares a bit with `bit`.
    unsafe fn test32(p: *const u16, bit: u16) -> u32;
    /// A bit for each of 16 whole numbers at `p` that is greater than `x` (both below 2³¹).
    unsafe fn greater(p: *const u32, x: u32) -> u16;
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

/// Holds kernels to an instruction set while it lives, one test after the other.
#[cfg(test)]
pub(crate) fn hold(level: Level) -> Held {
    let guard = ONE_AT_A_TIME.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    HELD.store(level as u8 + 1, std::sync::atomic::Ordering::SeqCst);
    Held { _guard: guard }
}

#[cfg(test)]
static ONE_AT_A_TIME: std::sync::Mutex<()> = std::sync::Mutex::new(());
#[cfg(test)]
static HELD: std::sync::atomic::AtomicU8 = std::sync::atomic::AtomicU8::new(0);

/// See [`hold`].
#[cfg(test)]
pub(crate) struct Held {
    _guard: std::sync::MutexGuard<'static, ()>,
}

#[cfg(test)]
impl Drop for Held {
    fn drop(&mut self) {
        HELD.store(0, std::sync::atomic::Ordering::SeqCst);
    }
}

/// The widest set the machine has (or `RISORIUS_SIMD` allows).
pub fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    #[cfg(test)]
    match HELD.load(std::sync::atomic::Ordering::SeqCst) {
        1 => return Level::Scalar,
        2 => return Level::Avx2.min(detected()),
        3 => return Level::Avx512.min(detected()),
        _ => {}
    }
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

/// Runs a kernel with the instructions of `level`, or the widest below it that the machine has.
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
        match level.min(detected()) {
            Level::Avx512 => return unsafe { avx512(task) },
            Level::Avx2 => return unsafe { avx2(task) },
            Level::Scalar => {}
        }
    }
    let _ = level;
    task.run::<Scalar>()
}

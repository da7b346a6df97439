//! Vectors of 16 and of 4 numbers for whatever instructions the machine has, found at run time.
//!
//! A kernel is a [`Task`] whose body is generic over [`Simd`]; [`run`] compiles it once per instruction set and picks the
//! widest one the machine supports. `RISORIUS_SIMD=scalar|avx2|avx512` narrows the choice, for tests and measurements.
#![allow(unsafe_code, reason = "vector instructions behind one small border; every caller is checked in debug builds")]
#![allow(
    clippy::missing_safety_doc,
    reason = "all operations: the instruction set must be present, pointers must be valid"
)]
#![allow(
    clippy::undocumented_unsafe_blocks,
    reason = "each is one instruction or one access: what makes it sound stands once, above and at the trait"
)]

mod scalar;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::OnceLock;

pub use self::scalar::Scalar;

/// The operations that the kernels are made of.
///
/// # Safety
/// What every operation asks of its caller: the machine has the instruction set (only [`run_at`] hands out a set, and never
/// one that the machine lacks); pointers to 16 or 4 numbers are valid for as many, at any alignment; each index of a
/// gather lies inside what `p` points to.
pub trait Simd: Copy + 'static {
    /// 16 numbers.
    type V: Copy;
    /// 16 whole numbers of 32 bits.
    type I: Copy;
    /// Which of 16.
    type M: Copy;
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

    /// a − b
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    /// a · b
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// The larger of both; `b` where `a` is no number.
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    /// The smaller of both; `b` where `a` is no number.
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V;

    /// a / b
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
    /// √a
    unsafe fn sqrt(a: Self::V) -> Self::V;
    /// Where a is not 0; a number that is none is not.
    unsafe fn some(a: Self::V) -> Self::M;
    /// Fetches what `p` points to into the cache; any pointer will do.
    unsafe fn prefetch(p: *const f32);

    /// The next whole number upwards.
    unsafe fn ceil(a: Self::V) -> Self::V;
    /// Where a < b.
    unsafe fn lt(a: Self::V, b: Self::V) -> Self::M;
    /// `a` where `m`, else `b`.
    unsafe fn select(m: Self::M, a: Self::V, b: Self::V) -> Self::V;
    /// A bit each, the first the lowest.
    unsafe fn m_bits(m: Self::M) -> u16;
    /// The other way round.
    unsafe fn m_from(bits: u16) -> Self::M;

    /// 16 times `x`.
    unsafe fn i_splat(x: i32) -> Self::I;
    /// Where a is not 0.
    unsafe fn i_some(a: Self::I) -> Self::M;
    /// `a` where `m`, else `b`.
    unsafe fn i_select(m: Self::M, a: Self::I, b: Self::I) -> Self::I;
    /// a >> b
    unsafe fn i_right(a: Self::I, b: Self::I) -> Self::I;
    /// The 32 bits that begin at `p[i]`.
    unsafe fn i_gather_pairs(p: *const u16, i: Self::I) -> Self::I;
    /// The whole parts of numbers that fit.
    unsafe fn i_from(v: Self::V) -> Self::I;
    /// Whole numbers as numbers.
    unsafe fn i_to(v: Self::I) -> Self::V;
    /// The numbers that have these bits.
    unsafe fn i_bits(v: Self::I) -> Self::V;
    /// 16 whole numbers to `p`.
    unsafe fn i_store(p: *mut u32, v: Self::I);
    /// a + b
    unsafe fn i_add(a: Self::I, b: Self::I) -> Self::I;
    /// The low 32 bits of a · b.
    unsafe fn i_mul(a: Self::I, b: Self::I) -> Self::I;
    /// a & b
    unsafe fn i_and(a: Self::I, b: Self::I) -> Self::I;
    /// a / 8 of numbers that are not negative.
    unsafe fn i_eighth(a: Self::I) -> Self::I;
    /// The larger of both.
    unsafe fn i_max(a: Self::I, b: Self::I) -> Self::I;
    /// `p[i]`
    unsafe fn i_gather(p: *const u32, i: Self::I) -> Self::I;

    /// 4 times `x`.
    unsafe fn q_splat(x: f32) -> Self::Q;
    /// 4 numbers from `p`.
    unsafe fn q_load(p: *const f32) -> Self::Q;
    /// 4 numbers to `p`.
    unsafe fn q_store(p: *mut f32, v: Self::Q);
    /// a · b + c
    unsafe fn q_fma(a: Self::Q, b: Self::Q, c: Self::Q) -> Self::Q;
    /// a + b
    unsafe fn q_add(a: Self::Q, b: Self::Q) -> Self::Q;
    /// a − b
    unsafe fn q_sub(a: Self::Q, b: Self::Q) -> Self::Q;
    /// a · b
    unsafe fn q_mul(a: Self::Q, b: Self::Q) -> Self::Q;
    /// a / b
    unsafe fn q_div(a: Self::Q, b: Self::Q) -> Self::Q;
    /// √a
    unsafe fn q_sqrt(a: Self::Q) -> Self::Q;
    /// The larger of both; `b` where `a` is no number.
    unsafe fn q_max(a: Self::Q, b: Self::Q) -> Self::Q;
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

//! A vector with operators, and the functions that the kernels share.

#![allow(clippy::return_self_not_must_use, reason = "arithmetic, as of numbers")]

use std::ops::{Add, AddAssign, Mul, Neg, Sub};

use super::Simd;

/// Sixteen numbers in memory.
pub type Row = [f32; 16];

/// A slice as rows of 16; what is left over is not seen.
#[inline(always)]
pub fn rows(values: &[f32]) -> &[Row] {
    values.as_chunks::<16>().0
}

/// A mutable slice as rows of 16.
#[inline(always)]
pub fn rows_mut(values: &mut [f32]) -> &mut [Row] {
    values.as_chunks_mut::<16>().0
}

/// Sixteen numbers in a register. Values exist only inside a [`super::Task`], whose caller has checked the instructions.
#[derive(Clone, Copy)]
pub struct F<S: Simd>(pub S::V);

/// Which of sixteen.
#[derive(Clone, Copy)]
pub struct M<S: Simd>(pub S::M);

impl<S: Simd> F<S> {
    /// 16 times `x`.
    #[inline(always)]
    pub fn splat(x: f32) -> Self {
        Self(unsafe { S::splat(x) })
    }
    /// From memory.
    #[inline(always)]
    pub fn load(row: &Row) -> Self {
        Self(unsafe { S::load(row.as_ptr()) })
    }
    /// To memory.
    #[inline(always)]
    pub fn store(self, row: &mut Row) {
        unsafe { S::store(row.as_mut_ptr(), self.0) }
    }
    /// As an array.
    #[inline(always)]
    pub fn array(self) -> Row {
        let mut row = [0.0; 16];
        self.store(&mut row);
        row
    }
    /// self · b + c
    #[inline(always)]
    pub fn fma(self, b: Self, c: Self) -> Self {
        Self(unsafe { S::fma(self.0, b.0, c.0) })
    }
    /// c − self · b
    #[inline(always)]
    pub fn fnma(self, b: Self, c: Self) -> Self {
        Self(unsafe { S::fnma(self.0, b.0, c.0) })
    }
    /// self / b
    #[inline(always)]
    pub fn over(self, b: Self) -> Self {
        Self(unsafe { S::div(self.0, b.0) })
    }
    /// The larger of both; `b` where `self` is NaN.
    #[inline(always)]
    pub fn max(self, b: Self) -> Self {
        Self(unsafe { S::max(self.0, b.0) })
    }
    /// The smaller of both; `b` where `self` is NaN.
    #[inline(always)]
    pub fn min(self, b: Self) -> Self {
        Self(unsafe { S::min(self.0, b.0) })
    }
    /// √self
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self(unsafe { S::sqrt(self.0) })
    }
    /// 1 / self to about 1e-6.
    #[inline(always)]
    pub fn reciprocal(self) -> Self {
        Self(unsafe { S::reciprocal(self.0) })
    }
    /// 1 / self to about 1e-4.
    #[inline(always)]
    pub fn reciprocal_rough(self) -> Self {
        Self(unsafe { S::reciprocal_rough(self.0) })
    }
    /// The greatest whole number that is not above self.
    #[inline(always)]
    pub fn floor(self) -> Self {
        Self(unsafe { S::floor(self.0) })
    }
    /// The nearest whole number.
    #[inline(always)]
    pub fn round(self) -> Self {
        Self(unsafe { S::round(self.0) })
    }
    /// Where self < b.
    #[inline(always)]
    pub fn lt(self, b: Self) -> M<S> {
        M(unsafe { S::lt(self.0, b.0) })
    }
    /// The sum of all 16.
    #[inline(always)]
    pub fn sum(self) -> f32 {
        unsafe { S::sum(self.0) }
    }
}

/// Fetches a row into the cache, if there is one at `index`.
#[inline(always)]
pub fn prefetch<S: Simd, T>(list: &[T], index: usize) {
    if let Some(item) = list.get(index) {
        unsafe { S::prefetch(std::ptr::from_ref(item).cast()) };
    }
}

/// Rows become columns.
#[inline(always)]
pub fn transpose<S: Simd>(v: &mut [F<S>; 16]) {
    let mut raw = [v[0].0; 16];
    for i in 0..16 {
        raw[i] = v[i].0;
    }
    unsafe { S::transpose(&mut raw) };
    for i in 0..16 {
        v[i] = F(raw[i]);
    }
}

/// The sums of eight vectors.
#[inline(always)]
pub fn sums8<S: Simd>(v: &[F<S>; 8]) -> [f32; 8] {
    let mut raw = [v[0].0; 8];
    for i in 0..8 {
        raw[i] = v[i].0;
    }
    unsafe { S::sums8(&raw) }
}

/// A bit for each of 32 masks that shares a bit with `bit`.
#[inline(always)]
pub fn test32<S: Simd>(masks: &[u16; 32], bit: u16) -> u32 {
    unsafe { S::test32(masks.as_ptr(), bit) }
}

/// A bit for each of 16 whole numbers (below 2³¹) that is greater than `x`.
#[inline(always)]
pub fn greater<S: Simd>(values: &[u32; 16], x: u32) -> u16 {
    unsafe { S::greater(values.as_ptr(), x) }
}

impl<S: Simd> M<S> {
    /// From a bit each.
    #[inline(always)]
    pub fn from_bits(bits: u16) -> Self {
        Self(unsafe { S::m_from(bits) })
    }
    /// A bit each.
    #[inline(always)]
    pub fn bits(self) -> u16 {
        unsafe { S::m_bits(self.0) }
    }
    /// Where both.
    #[inline(always)]
    pub fn and(self, b: Self) -> Self {
        Self(unsafe { S::m_and(self.0, b.0) })
    }
    /// `a` where set, else `b`.
    #[inline(always)]
    pub fn select(self, a: F<S>, b: F<S>) -> F<S> {
        F(unsafe { S::select(self.0, a.0, b.0) })
    }
}

impl<S: Simd> Add for F<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, b: Self) -> Self {
        Self(unsafe { S::add(self.0, b.0) })
    }
}

impl<S: Simd> AddAssign for F<S> {
    #[inline(always)]
    fn add_assign(&mut self, b: Self) {
        *self = *self + b;
    }
}

impl<S: Simd> Sub for F<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        Self(unsafe { S::sub(self.0, b.0) })
    }
}

impl<S: Simd> Mul for F<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        Self(unsafe { S::mul(self.0, b.0) })
    }
}

impl<S: Simd> Mul<f32> for F<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, b: f32) -> Self {
        self * Self::splat(b)
    }
}

impl<S: Simd> Neg for F<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self::splat(0.0) - self
    }
}

/// 2^x for x ≤ 127, relative error 4e-6; 2⁻¹²⁶ or less below −126. For pixels.
#[inline(always)]
pub fn exp2_fast<S: Simd>(x: F<S>) -> F<S> {
    let (f, whole) = unsafe { S::parts(x.0) };
    let f = F::<S>(f);
    let p = f.fma(F::splat(0.013_534_167), F::splat(0.052_011_46));
    let p = p.fma(f, F::splat(0.241_442_76));
    let p = p.fma(f, F::splat(0.693_003_8));
    let p = p.fma(f, F::splat(1.000_002_7));
    F(unsafe { S::scale2(p.0, whole) })
}

/// 2^x clamped to ±126, relative error 1e-7.
#[inline(always)]
pub fn exp2<S: Simd>(x: F<S>) -> F<S> {
    let x = x.max(F::splat(-126.0)).min(F::splat(126.0));
    let r = x.round();
    let f = x - r;
    let p = f.fma(F::splat(0.000_153_458_11), F::splat(0.001_339_993_1));
    let p = p.fma(f, F::splat(0.009_618_489));
    let p = p.fma(f, F::splat(0.055_503_29));
    let p = p.fma(f, F::splat(0.240_226_47));
    let p = p.fma(f, F::splat(std::f32::consts::LN_2));
    let p = p.fma(f, F::splat(1.0));
    F(unsafe { S::scale2(p.0, r.0) })
}

/// log2 of a positive normal number, absolute error 2e-7 near 1: 2/ln 2 · artanh((m − 1)/(m + 1)), m in √½..√2.
#[inline(always)]
pub fn log2<S: Simd>(x: F<S>) -> F<S> {
    let (m, e) = unsafe { S::split(x.0) };
    let (m, e) = (F::<S>(m), F::<S>(e));
    let large = F::splat(std::f32::consts::SQRT_2).lt(m);
    let m = large.select(m * 0.5, m);
    let e = large.select(e + F::splat(1.0), e);
    let one = F::splat(1.0);
    let t = (m - one).over(m + one);
    let t2 = t * t;
    let p = t2.fma(F::splat(0.320_598_88), F::splat(0.412_198_57));
    let p = p.fma(t2, F::splat(0.577_078_04));
    let p = p.fma(t2, F::splat(0.961_796_7));
    let p = p.fma(t2, F::splat(2.885_39));
    p.fma(t, e)
}

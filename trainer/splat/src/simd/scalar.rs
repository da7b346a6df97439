//! Sixteen numbers in an array: what every machine can do, and the readable twin of the other two.

use super::Simd;

/// No assumption about the machine; the compiler makes of it what the target has (NEON on arm64).
#[derive(Clone, Copy, Debug)]
pub struct Scalar;

macro_rules! each {
    ($i:ident => $e:expr) => {{
        let mut out = [0.0f32; 16];
        let mut $i = 0;
        while $i < 16 {
            out[$i] = $e;
            $i += 1;
        }
        out
    }};
}

macro_rules! which {
    ($i:ident => $e:expr) => {{
        let mut out = [false; 16];
        let mut $i = 0;
        while $i < 16 {
            out[$i] = $e;
            $i += 1;
        }
        out
    }};
}

impl Simd for Scalar {
    type V = [f32; 16];
    type M = [bool; 16];

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self::V {
        [x; 16]
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self::V {
        unsafe { p.cast::<[f32; 16]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: Self::V) {
        unsafe { p.cast::<[f32; 16]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
        each!(i => a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V {
        each!(i => a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
        each!(i => a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V {
        each!(i => a[i] / b[i])
    }
    #[inline(always)]
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        each!(i => fused(a[i], b[i], c[i]))
    }
    #[inline(always)]
    unsafe fn fnma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        each!(i => fused(-a[i], b[i], c[i]))
    }
    #[inline(always)]
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
        each!(i => if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V {
        each!(i => if a[i] < b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn sqrt(a: Self::V) -> Self::V {
        each!(i => a[i].sqrt())
    }
    #[inline(always)]
    unsafe fn reciprocal(a: Self::V) -> Self::V {
        each!(i => 1.0 / a[i])
    }
    #[inline(always)]
    unsafe fn round(a: Self::V) -> Self::V {
        // Adding and taking away 1.5 · 2²³ rounds to even; numbers from 2²² on are left as they are.
        const MAGIC: f32 = 12_582_912.0;
        each!(i => if a[i].abs() < 4_194_304.0 { (a[i] + MAGIC) - MAGIC } else { a[i] })
    }
    #[inline(always)]
    unsafe fn reciprocal_rough(a: Self::V) -> Self::V {
        unsafe { Self::reciprocal(a) }
    }
    #[inline(always)]
    unsafe fn floor(a: Self::V) -> Self::V {
        each!(i => a[i].floor())
    }
    #[inline(always)]
    unsafe fn parts(a: Self::V) -> (Self::V, Self::V) {
        let whole = each!(i => a[i].max(-126.0).floor());
        (each!(i => a[i].max(-126.0) - whole[i]), whole)
    }
    #[inline(always)]
    unsafe fn scale2(a: Self::V, r: Self::V) -> Self::V {
        each!(i => a[i] * f32::from_bits(((r[i] as i32 + 127) as u32) << 23))
    }
    #[inline(always)]
    unsafe fn split(a: Self::V) -> (Self::V, Self::V) {
        let m = each!(i => f32::from_bits(a[i].to_bits() & 0x007f_ffff | 0x3f80_0000));
        let e = each!(i => ((a[i].to_bits() >> 23) as i32 - 127) as f32);
        (m, e)
    }
    #[inline(always)]
    unsafe fn lt(a: Self::V, b: Self::V) -> Self::M {
        which!(i => a[i] < b[i])
    }
    #[inline(always)]
    unsafe fn m_and(a: Self::M, b: Self::M) -> Self::M {
        which!(i => a[i] & b[i])
    }
    #[inline(always)]
    unsafe fn select(m: Self::M, a: Self::V, b: Self::V) -> Self::V {
        each!(i => if m[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn m_bits(m: Self::M) -> u16 {
        let mut bits = 0;
        let mut i = 0;
        while i < 16 {
            bits |= u16::from(m[i]) << i;
            i += 1;
        }
        bits
    }
    #[inline(always)]
    unsafe fn m_from(bits: u16) -> Self::M {
        which!(i => bits >> i & 1 == 1)
    }
    #[inline(always)]
    unsafe fn sum(a: Self::V) -> f32 {
        sum(&a)
    }
    #[inline(always)]
    unsafe fn sums8(v: &[Self::V; 8]) -> [f32; 8] {
        let mut out = [0.0; 8];
        let mut i = 0;
        while i < 8 {
            out[i] = sum(&v[i]);
            i += 1;
        }
        out
    }
    #[inline(always)]
    unsafe fn transpose(v: &mut [Self::V; 16]) {
        let mut r = 0;
        while r < 16 {
            let mut c = r + 1;
            while c < 16 {
                let kept = v[r][c];
                v[r][c] = v[c][r];
                v[c][r] = kept;
                c += 1;
            }
            r += 1;
        }
    }
    #[inline(always)]
    unsafe fn prefetch(_: *const f32) {}
    #[inline(always)]
    unsafe fn test32(p: *const u16, bit: u16) -> u32 {
        let masks = unsafe { p.cast::<[u16; 32]>().read_unaligned() };
        let mut bits = 0;
        let mut i = 0;
        while i < 32 {
            bits |= u32::from(masks[i] & bit != 0) << i;
            i += 1;
        }
        bits
    }
    #[inline(always)]
    unsafe fn greater(p: *const u32, x: u32) -> u16 {
        let v = unsafe { p.cast::<[u32; 16]>().read_unaligned() };
        let mut bits = 0;
        let mut i = 0;
        while i < 16 {
            bits |= u16::from(v[i] > x) << i;
            i += 1;
        }
        bits
    }
}

/// a · b + c, rounded once where the target can do that in one instruction.
#[inline(always)]
fn fused(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(any(target_feature = "fma", target_arch = "aarch64")) { a.mul_add(b, c) } else { a * b + c }
}

/// Quarters of four first, then their sums: the order of the wide instructions.
#[inline(always)]
fn sum(a: &[f32; 16]) -> f32 {
    let mut half = [0.0f32; 8];
    let mut i = 0;
    while i < 8 {
        half[i] = a[i] + a[i + 8];
        i += 1;
    }
    let q = [half[0] + half[4], half[1] + half[5], half[2] + half[6], half[3] + half[7]];
    (q[0] + q[2]) + (q[1] + q[3])
}

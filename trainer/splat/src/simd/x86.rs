//! x86-64 with AVX2 and with AVX-512.

#[allow(clippy::wildcard_imports, reason = "fifty intrinsics, each named after what it does")]
use std::arch::x86_64::*;

use super::Simd;

#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512;

#[inline(always)]
unsafe fn upper(v: __m512) -> __m256 {
    unsafe { _mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(_mm512_castps_pd(v))) }
}

/// 8 numbers to one: i + i+4, then the pairs.
#[inline(always)]
unsafe fn sum8(h: __m256) -> f32 {
    unsafe {
        let q = _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps::<1>(h));
        let p = _mm_add_ps(q, _mm_movehl_ps(q, q));
        _mm_cvtss_f32(_mm_add_ss(p, _mm_shuffle_ps::<1>(p, p)))
    }
}

/// The sums of eight vectors of eight, each in the order of [`sum8`].
#[inline(always)]
unsafe fn sums_of_halves(h: &[__m256; 8]) -> [f32; 8] {
    unsafe {
        // i + i+4 of two vectors in one register, then (0 + 2) and (1 + 3), then the pair.
        let fold = |a: __m256, b: __m256| {
            _mm256_add_ps(_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b))
        };
        let ab = fold(h[0], h[4]);
        let cd = fold(h[1], h[5]);
        let ef = fold(h[2], h[6]);
        let gh = fold(h[3], h[7]);
        let halves = |a: __m256, b: __m256| {
            let (a, b) = (_mm256_castps_pd(a), _mm256_castps_pd(b));
            _mm256_add_ps(_mm256_castpd_ps(_mm256_unpacklo_pd(a, b)), _mm256_castpd_ps(_mm256_unpackhi_pd(a, b)))
        };
        let x = halves(ab, cd);
        let y = halves(ef, gh);
        let s = _mm256_add_ps(_mm256_shuffle_ps::<0b10_00_10_00>(x, y), _mm256_shuffle_ps::<0b11_01_11_01>(x, y));
        let mut out = [0.0f32; 8];
        _mm256_storeu_ps(out.as_mut_ptr(), s);
        out
    }
}

impl Simd for Avx512 {
    type V = __m512;
    type M = __mmask16;

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
    unsafe fn add(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_add_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn sub(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_sub_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn mul(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_mul_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn div(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_div_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn fma(a: __m512, b: __m512, c: __m512) -> __m512 {
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    unsafe fn fnma(a: __m512, b: __m512, c: __m512) -> __m512 {
        unsafe { _mm512_fnmadd_ps(a, b, c) }
    }
    #[inline(always)]
    unsafe fn max(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_max_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn min(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_min_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn sqrt(a: __m512) -> __m512 {
        unsafe { _mm512_sqrt_ps(a) }
    }
    #[inline(always)]
    unsafe fn reciprocal(a: __m512) -> __m512 {
        unsafe {
            let r = _mm512_rcp14_ps(a);
            _mm512_mul_ps(r, _mm512_fnmadd_ps(a, r, _mm512_set1_ps(2.0)))
        }
    }
    #[inline(always)]
    unsafe fn reciprocal_rough(a: __m512) -> __m512 {
        unsafe { _mm512_rcp14_ps(a) }
    }
    #[inline(always)]
    unsafe fn round(a: __m512) -> __m512 {
        unsafe { _mm512_roundscale_ps::<0x08>(a) }
    }
    #[inline(always)]
    unsafe fn floor(a: __m512) -> __m512 {
        unsafe { _mm512_roundscale_ps::<0x09>(a) }
    }
    #[inline(always)]
    unsafe fn scale2(a: __m512, r: __m512) -> __m512 {
        unsafe { _mm512_scalef_ps(a, r) }
    }
    #[inline(always)]
    unsafe fn parts(a: __m512) -> (__m512, __m512) {
        // The instruction that scales takes the floor itself.
        unsafe { (_mm512_reduce_ps::<0x09>(a), a) }
    }
    #[inline(always)]
    unsafe fn split(a: __m512) -> (__m512, __m512) {
        unsafe { (_mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_ZERO>(a), _mm512_getexp_ps(a)) }
    }
    #[inline(always)]
    unsafe fn lt(a: __m512, b: __m512) -> __mmask16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) }
    }
    #[inline(always)]
    unsafe fn m_and(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    unsafe fn select(m: __mmask16, a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_mask_blend_ps(m, b, a) }
    }
    #[inline(always)]
    unsafe fn m_bits(m: __mmask16) -> u16 {
        m
    }
    #[inline(always)]
    unsafe fn m_from(bits: u16) -> __mmask16 {
        bits
    }
    #[inline(always)]
    unsafe fn sum(a: __m512) -> f32 {
        unsafe { sum8(_mm256_add_ps(_mm512_castps512_ps256(a), upper(a))) }
    }
    #[inline(always)]
    unsafe fn sums8(v: &[__m512; 8]) -> [f32; 8] {
        unsafe {
            let half = |a: __m512| _mm256_add_ps(_mm512_castps512_ps256(a), upper(a));
            sums_of_halves(&[
                half(v[0]),
                half(v[1]),
                half(v[2]),
                half(v[3]),
                half(v[4]),
                half(v[5]),
                half(v[6]),
                half(v[7]),
            ])
        }
    }
    #[inline(always)]
    unsafe fn transpose(v: &mut [__m512; 16]) {
        unsafe {
            let mut t = *v;
            for i in 0..8 {
                t[2 * i] = _mm512_unpacklo_ps(v[2 * i], v[2 * i + 1]);
                t[2 * i + 1] = _mm512_unpackhi_ps(v[2 * i], v[2 * i + 1]);
            }
            let mut r = t;
            for i in 0..4 {
                let (a, b, c, d) = (
                    _mm512_castps_pd(t[4 * i]),
                    _mm512_castps_pd(t[4 * i + 1]),
                    _mm512_castps_pd(t[4 * i + 2]),
                    _mm512_castps_pd(t[4 * i + 3]),
                );
                r[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
                r[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
                r[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
                r[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
            }
            // r[4i + j] holds column j, 4+j, 8+j, 12+j of rows 4i..4i+4 in its quarters.
            for j in 0..4 {
                let (a, b, c, d) = (r[j], r[4 + j], r[8 + j], r[12 + j]);
                let ab_low = _mm512_shuffle_f32x4::<0x88>(a, b);
                let ab_high = _mm512_shuffle_f32x4::<0xdd>(a, b);
                let cd_low = _mm512_shuffle_f32x4::<0x88>(c, d);
                let cd_high = _mm512_shuffle_f32x4::<0xdd>(c, d);
                v[j] = _mm512_shuffle_f32x4::<0x88>(ab_low, cd_low);
                v[8 + j] = _mm512_shuffle_f32x4::<0xdd>(ab_low, cd_low);
                v[4 + j] = _mm512_shuffle_f32x4::<0x88>(ab_high, cd_high);
                v[12 + j] = _mm512_shuffle_f32x4::<0xdd>(ab_high, cd_high);
            }
        }
    }
    #[inline(always)]
    unsafe fn prefetch(p: *const f32) {
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }
    #[inline(always)]
    unsafe fn test32(p: *const u16, bit: u16) -> u32 {
        unsafe { _mm512_test_epi16_mask(_mm512_loadu_si512(p.cast()), _mm512_set1_epi16(bit as i16)) }
    }
    #[inline(always)]
    unsafe fn greater(p: *const u32, x: u32) -> u16 {
        unsafe { _mm512_cmpgt_epi32_mask(_mm512_loadu_si512(p.cast()), _mm512_set1_epi32(x as i32)) }
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2;

type Pair = [__m256; 2];

macro_rules! both {
    ($op:ident($($a:ident),*)) => {
        [$op($($a[0]),*), $op($($a[1]),*)]
    };
}

impl Simd for Avx2 {
    type V = Pair;
    type M = Pair;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Pair {
        unsafe { [_mm256_set1_ps(x); 2] }
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Pair {
        unsafe { [_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))] }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: Pair) {
        unsafe {
            _mm256_storeu_ps(p, v[0]);
            _mm256_storeu_ps(p.add(8), v[1]);
        }
    }
    #[inline(always)]
    unsafe fn add(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_add_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn sub(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_sub_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn mul(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_mul_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn div(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_div_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn fma(a: Pair, b: Pair, c: Pair) -> Pair {
        unsafe { both!(_mm256_fmadd_ps(a, b, c)) }
    }
    #[inline(always)]
    unsafe fn fnma(a: Pair, b: Pair, c: Pair) -> Pair {
        unsafe { both!(_mm256_fnmadd_ps(a, b, c)) }
    }
    #[inline(always)]
    unsafe fn max(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_max_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn min(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_min_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn sqrt(a: Pair) -> Pair {
        unsafe { both!(_mm256_sqrt_ps(a)) }
    }
    #[inline(always)]
    unsafe fn reciprocal(a: Pair) -> Pair {
        unsafe {
            let one = [_mm256_set1_ps(1.0); 2];
            both!(_mm256_div_ps(one, a))
        }
    }
    #[inline(always)]
    unsafe fn round(a: Pair) -> Pair {
        unsafe { [_mm256_round_ps::<8>(a[0]), _mm256_round_ps::<8>(a[1])] }
    }
    #[inline(always)]
    unsafe fn reciprocal_rough(a: Pair) -> Pair {
        unsafe { Self::reciprocal(a) }
    }
    #[inline(always)]
    unsafe fn floor(a: Pair) -> Pair {
        unsafe { [_mm256_floor_ps(a[0]), _mm256_floor_ps(a[1])] }
    }
    #[inline(always)]
    unsafe fn parts(a: Pair) -> (Pair, Pair) {
        unsafe {
            let a = Self::max(a, Self::splat(-126.0));
            let whole = Self::floor(a);
            (Self::sub(a, whole), whole)
        }
    }
    #[inline(always)]
    unsafe fn scale2(a: Pair, r: Pair) -> Pair {
        unsafe {
            let power = |r: __m256| {
                let e = _mm256_add_epi32(_mm256_cvtps_epi32(r), _mm256_set1_epi32(127));
                _mm256_castsi256_ps(_mm256_slli_epi32::<23>(e))
            };
            [_mm256_mul_ps(a[0], power(r[0])), _mm256_mul_ps(a[1], power(r[1]))]
        }
    }
    #[inline(always)]
    unsafe fn split(a: Pair) -> (Pair, Pair) {
        unsafe {
            let mantissa = |a: __m256| {
                let bits = _mm256_and_si256(_mm256_castps_si256(a), _mm256_set1_epi32(0x007f_ffff));
                _mm256_castsi256_ps(_mm256_or_si256(bits, _mm256_set1_epi32(0x3f80_0000)))
            };
            let exponent = |a: __m256| {
                let e = _mm256_srli_epi32::<23>(_mm256_castps_si256(a));
                _mm256_cvtepi32_ps(_mm256_sub_epi32(e, _mm256_set1_epi32(127)))
            };
            ([mantissa(a[0]), mantissa(a[1])], [exponent(a[0]), exponent(a[1])])
        }
    }
    #[inline(always)]
    unsafe fn lt(a: Pair, b: Pair) -> Pair {
        unsafe { [_mm256_cmp_ps::<_CMP_LT_OQ>(a[0], b[0]), _mm256_cmp_ps::<_CMP_LT_OQ>(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn m_and(a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_and_ps(a, b)) }
    }
    #[inline(always)]
    unsafe fn select(m: Pair, a: Pair, b: Pair) -> Pair {
        unsafe { both!(_mm256_blendv_ps(b, a, m)) }
    }
    #[inline(always)]
    unsafe fn m_bits(m: Pair) -> u16 {
        unsafe { _mm256_movemask_ps(m[0]) as u16 | (_mm256_movemask_ps(m[1]) as u16) << 8 }
    }
    #[inline(always)]
    unsafe fn m_from(bits: u16) -> Pair {
        unsafe {
            let half = |bits: u16| {
                let lanes = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
                let own = _mm256_and_si256(_mm256_set1_epi32(i32::from(bits)), lanes);
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(own, lanes))
            };
            [half(bits & 0xff), half(bits >> 8)]
        }
    }
    #[inline(always)]
    unsafe fn sum(a: Pair) -> f32 {
        unsafe { sum8(_mm256_add_ps(a[0], a[1])) }
    }
    #[inline(always)]
    unsafe fn sums8(v: &[Pair; 8]) -> [f32; 8] {
        unsafe {
            let half = |a: &Pair| _mm256_add_ps(a[0], a[1]);
            sums_of_halves(&[
                half(&v[0]),
                half(&v[1]),
                half(&v[2]),
                half(&v[3]),
                half(&v[4]),
                half(&v[5]),
                half(&v[6]),
                half(&v[7]),
            ])
        }
    }
    #[inline(always)]
    unsafe fn transpose(v: &mut [Pair; 16]) {
        unsafe {
            let block = |row: usize, column: usize| -> [__m256; 8] {
                let r = |i: usize| v[row + i][column];
                let mut t = [_mm256_setzero_ps(); 8];
                for i in 0..4 {
                    t[2 * i] = _mm256_unpacklo_ps(r(2 * i), r(2 * i + 1));
                    t[2 * i + 1] = _mm256_unpackhi_ps(r(2 * i), r(2 * i + 1));
                }
                let mut s = t;
                for i in 0..2 {
                    s[4 * i] = _mm256_shuffle_ps::<0x44>(t[4 * i], t[4 * i + 2]);
                    s[4 * i + 1] = _mm256_shuffle_ps::<0xee>(t[4 * i], t[4 * i + 2]);
                    s[4 * i + 2] = _mm256_shuffle_ps::<0x44>(t[4 * i + 1], t[4 * i + 3]);
                    s[4 * i + 3] = _mm256_shuffle_ps::<0xee>(t[4 * i + 1], t[4 * i + 3]);
                }
                let mut out = s;
                for i in 0..4 {
                    out[i] = _mm256_permute2f128_ps::<0x20>(s[i], s[4 + i]);
                    out[4 + i] = _mm256_permute2f128_ps::<0x31>(s[i], s[4 + i]);
                }
                out
            };
            let (a, b, c, d) = (block(0, 0), block(0, 1), block(8, 0), block(8, 1));
            for i in 0..8 {
                v[i] = [a[i], c[i]];
                v[8 + i] = [b[i], d[i]];
            }
        }
    }
    #[inline(always)]
    unsafe fn prefetch(p: *const f32) {
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }
    #[inline(always)]
    unsafe fn test32(p: *const u16, bit: u16) -> u32 {
        unsafe {
            let b = _mm256_set1_epi16(bit as i16);
            let zero = |p: *const u16| {
                let own = _mm256_and_si256(_mm256_loadu_si256(p.cast()), b);
                _mm256_cmpeq_epi16(own, _mm256_setzero_si256())
            };
            let packed = _mm256_packs_epi16(zero(p), zero(p.add(16)));
            !(_mm256_movemask_epi8(_mm256_permute4x64_epi64::<0b11_01_10_00>(packed)) as u32)
        }
    }
    #[inline(always)]
    unsafe fn greater(p: *const u32, x: u32) -> u16 {
        unsafe {
            let x = _mm256_set1_epi32(x as i32);
            let half = |p: *const u32| {
                let m = _mm256_cmpgt_epi32(_mm256_loadu_si256(p.cast()), x);
                _mm256_movemask_ps(_mm256_castsi256_ps(m)) as u16
            };
            half(p) | half(p.add(8)) << 8
        }
    }
}

//! x86-64 with AVX2 and with AVX-512.

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
        unsafe fn q_add(a: __m128, b: __m128) -> __m128 {
            unsafe { _mm_add_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn q_sub(a: __m128, b: __m128) -> __m128 {
            unsafe { _mm_sub_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn q_mul(a: __m128, b: __m128) -> __m128 {
            unsafe { _mm_mul_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn q_div(a: __m128, b: __m128) -> __m128 {
            unsafe { _mm_div_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn q_sqrt(a: __m128) -> __m128 {
            unsafe { _mm_sqrt_ps(a) }
        }
        #[inline(always)]
        unsafe fn prefetch(p: *const f32) {
            unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
        }
        #[inline(always)]
        unsafe fn q_max(a: __m128, b: __m128) -> __m128 {
            unsafe { _mm_max_ps(a, b) }
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
    type I = __m512i;
    type M = __mmask16;
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
    #[inline(always)]
    unsafe fn sub(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_sub_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn mul(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_mul_ps(a, b) }
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
    unsafe fn div(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_div_ps(a, b) }
    }
    #[inline(always)]
    unsafe fn sqrt(a: __m512) -> __m512 {
        unsafe { _mm512_sqrt_ps(a) }
    }
    #[inline(always)]
    unsafe fn some(a: __m512) -> __mmask16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_NEQ_UQ>(a, _mm512_setzero_ps()) }
    }
    #[inline(always)]
    unsafe fn ceil(a: __m512) -> __m512 {
        unsafe { _mm512_roundscale_ps::<0x0a>(a) }
    }
    #[inline(always)]
    unsafe fn lt(a: __m512, b: __m512) -> __mmask16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) }
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
    unsafe fn i_some(a: __m512i) -> __mmask16 {
        unsafe { _mm512_test_epi32_mask(a, a) }
    }
    #[inline(always)]
    unsafe fn i_select(m: __mmask16, a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_mask_blend_epi32(m, b, a) }
    }
    #[inline(always)]
    unsafe fn i_right(a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_srlv_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn i_gather_pairs(p: *const u16, i: __m512i) -> __m512i {
        unsafe { _mm512_i32gather_epi32::<2>(i, p.cast()) }
    }
    #[inline(always)]
    unsafe fn i_splat(x: i32) -> __m512i {
        unsafe { _mm512_set1_epi32(x) }
    }
    #[inline(always)]
    unsafe fn i_from(v: __m512) -> __m512i {
        unsafe { _mm512_cvttps_epi32(v) }
    }
    #[inline(always)]
    unsafe fn i_to(v: __m512i) -> __m512 {
        unsafe { _mm512_cvtepi32_ps(v) }
    }
    #[inline(always)]
    unsafe fn i_bits(v: __m512i) -> __m512 {
        unsafe { _mm512_castsi512_ps(v) }
    }
    #[inline(always)]
    unsafe fn i_store(p: *mut u32, v: __m512i) {
        unsafe { _mm512_storeu_si512(p.cast(), v) }
    }
    #[inline(always)]
    unsafe fn i_add(a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_add_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn i_mul(a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_mullo_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn i_and(a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_and_si512(a, b) }
    }
    #[inline(always)]
    unsafe fn i_eighth(a: __m512i) -> __m512i {
        unsafe { _mm512_srli_epi32::<3>(a) }
    }
    #[inline(always)]
    unsafe fn i_max(a: __m512i, b: __m512i) -> __m512i {
        unsafe { _mm512_max_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn i_gather(p: *const u32, i: __m512i) -> __m512i {
        unsafe { _mm512_i32gather_epi32::<4>(i, p.cast()) }
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2;

impl Simd for Avx2 {
    type V = [__m256; 2];
    type I = [__m256i; 2];
    type M = [__m256; 2];
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
        unsafe { [_mm256_max_ps(a[0], _mm256_setzero_ps()), _mm256_max_ps(a[1], _mm256_setzero_ps())] }
    }
    #[inline(always)]
    unsafe fn where_positive(gate: [__m256; 2], a: [__m256; 2]) -> [__m256; 2] {
        unsafe {
            let half = |g: __m256, v: __m256| _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(g, _mm256_setzero_ps()), v);
            [half(gate[0], a[0]), half(gate[1], a[1])]
        }
    }
    #[inline(always)]
    unsafe fn sub(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_sub_ps(a[0], b[0]), _mm256_sub_ps(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn mul(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn max(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_max_ps(a[0], b[0]), _mm256_max_ps(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn min(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_min_ps(a[0], b[0]), _mm256_min_ps(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn div(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_div_ps(a[0], b[0]), _mm256_div_ps(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn sqrt(a: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_sqrt_ps(a[0]), _mm256_sqrt_ps(a[1])] }
    }
    #[inline(always)]
    unsafe fn some(a: [__m256; 2]) -> [__m256; 2] {
        unsafe {
            let zero = _mm256_setzero_ps();
            [_mm256_cmp_ps::<_CMP_NEQ_UQ>(a[0], zero), _mm256_cmp_ps::<_CMP_NEQ_UQ>(a[1], zero)]
        }
    }
    #[inline(always)]
    unsafe fn ceil(a: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_ceil_ps(a[0]), _mm256_ceil_ps(a[1])] }
    }
    #[inline(always)]
    unsafe fn lt(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_cmp_ps::<_CMP_LT_OQ>(a[0], b[0]), _mm256_cmp_ps::<_CMP_LT_OQ>(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn select(m: [__m256; 2], a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        unsafe { [_mm256_blendv_ps(b[0], a[0], m[0]), _mm256_blendv_ps(b[1], a[1], m[1])] }
    }
    #[inline(always)]
    unsafe fn m_bits(m: [__m256; 2]) -> u16 {
        unsafe { _mm256_movemask_ps(m[0]) as u16 | (_mm256_movemask_ps(m[1]) as u16) << 8 }
    }
    #[inline(always)]
    unsafe fn m_from(bits: u16) -> [__m256; 2] {
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
    unsafe fn i_some(a: [__m256i; 2]) -> [__m256; 2] {
        unsafe {
            let some = |v: __m256i| {
                let none = _mm256_cmpeq_epi32(v, _mm256_setzero_si256());
                _mm256_castsi256_ps(_mm256_xor_si256(none, _mm256_set1_epi32(-1)))
            };
            [some(a[0]), some(a[1])]
        }
    }
    #[inline(always)]
    unsafe fn i_select(m: [__m256; 2], a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe {
            let one = |m: __m256, a: __m256i, b: __m256i| _mm256_blendv_epi8(b, a, _mm256_castps_si256(m));
            [one(m[0], a[0], b[0]), one(m[1], a[1], b[1])]
        }
    }
    #[inline(always)]
    unsafe fn i_right(a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_srlv_epi32(a[0], b[0]), _mm256_srlv_epi32(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn i_gather_pairs(p: *const u16, i: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_i32gather_epi32::<2>(p.cast(), i[0]), _mm256_i32gather_epi32::<2>(p.cast(), i[1])] }
    }
    #[inline(always)]
    unsafe fn i_splat(x: i32) -> [__m256i; 2] {
        unsafe { [_mm256_set1_epi32(x); 2] }
    }
    #[inline(always)]
    unsafe fn i_from(v: [__m256; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_cvttps_epi32(v[0]), _mm256_cvttps_epi32(v[1])] }
    }
    #[inline(always)]
    unsafe fn i_to(v: [__m256i; 2]) -> [__m256; 2] {
        unsafe { [_mm256_cvtepi32_ps(v[0]), _mm256_cvtepi32_ps(v[1])] }
    }
    #[inline(always)]
    unsafe fn i_bits(v: [__m256i; 2]) -> [__m256; 2] {
        unsafe { [_mm256_castsi256_ps(v[0]), _mm256_castsi256_ps(v[1])] }
    }
    #[inline(always)]
    unsafe fn i_store(p: *mut u32, v: [__m256i; 2]) {
        unsafe {
            _mm256_storeu_si256(p.cast(), v[0]);
            _mm256_storeu_si256(p.add(8).cast(), v[1]);
        }
    }
    #[inline(always)]
    unsafe fn i_add(a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_add_epi32(a[0], b[0]), _mm256_add_epi32(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn i_mul(a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_mullo_epi32(a[0], b[0]), _mm256_mullo_epi32(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn i_and(a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_and_si256(a[0], b[0]), _mm256_and_si256(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn i_eighth(a: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_srli_epi32::<3>(a[0]), _mm256_srli_epi32::<3>(a[1])] }
    }
    #[inline(always)]
    unsafe fn i_max(a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_max_epi32(a[0], b[0]), _mm256_max_epi32(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn i_gather(p: *const u32, i: [__m256i; 2]) -> [__m256i; 2] {
        unsafe { [_mm256_i32gather_epi32::<4>(p.cast(), i[0]), _mm256_i32gather_epi32::<4>(p.cast(), i[1])] }
    }
}

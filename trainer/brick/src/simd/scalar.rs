//! Vectors as plain arrays: for machines without vector instructions, and what the others are compared with.

use super::Simd;

/// Plain Rust.
#[derive(Clone, Copy, Debug)]
pub struct Scalar;

impl Simd for Scalar {
    type V = [f32; 16];
    type I = [i32; 16];
    type M = u16;
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
    unsafe fn sub(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn mul(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn max(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn min(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| if a[i] < b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn div(a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| a[i] / b[i])
    }
    #[inline(always)]
    unsafe fn sqrt(a: [f32; 16]) -> [f32; 16] {
        a.map(f32::sqrt)
    }
    #[inline(always)]
    unsafe fn some(a: [f32; 16]) -> u16 {
        (0..16).fold(0, |m, i| m | u16::from(a[i] != 0.0) << i)
    }
    #[inline(always)]
    unsafe fn prefetch(_: *const f32) {}
    #[inline(always)]
    unsafe fn ceil(a: [f32; 16]) -> [f32; 16] {
        a.map(f32::ceil)
    }
    #[inline(always)]
    unsafe fn lt(a: [f32; 16], b: [f32; 16]) -> u16 {
        (0..16).fold(0, |m, i| m | u16::from(a[i] < b[i]) << i)
    }
    #[inline(always)]
    unsafe fn select(m: u16, a: [f32; 16], b: [f32; 16]) -> [f32; 16] {
        std::array::from_fn(|i| if m >> i & 1 == 1 { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn m_bits(m: u16) -> u16 {
        m
    }
    #[inline(always)]
    unsafe fn m_from(bits: u16) -> u16 {
        bits
    }
    #[inline(always)]
    unsafe fn i_some(a: [i32; 16]) -> u16 {
        (0..16).fold(0, |m, i| m | u16::from(a[i] != 0) << i)
    }
    #[inline(always)]
    unsafe fn i_select(m: u16, a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| if m >> i & 1 == 1 { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn i_right(a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| a[i] >> b[i])
    }
    #[inline(always)]
    unsafe fn i_gather_pairs(p: *const u16, i: [i32; 16]) -> [i32; 16] {
        i.map(|i| unsafe { p.add(i as usize).cast::<i32>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn i_splat(x: i32) -> [i32; 16] {
        [x; 16]
    }
    #[inline(always)]
    unsafe fn i_from(v: [f32; 16]) -> [i32; 16] {
        v.map(|x| x as i32)
    }
    #[inline(always)]
    unsafe fn i_to(v: [i32; 16]) -> [f32; 16] {
        v.map(|x| x as f32)
    }
    #[inline(always)]
    unsafe fn i_bits(v: [i32; 16]) -> [f32; 16] {
        v.map(|x| f32::from_bits(x as u32))
    }
    #[inline(always)]
    unsafe fn i_store(p: *mut u32, v: [i32; 16]) {
        unsafe { p.cast::<[i32; 16]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn i_add(a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| a[i].wrapping_add(b[i]))
    }
    #[inline(always)]
    unsafe fn i_mul(a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| a[i].wrapping_mul(b[i]))
    }
    #[inline(always)]
    unsafe fn i_and(a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| a[i] & b[i])
    }
    #[inline(always)]
    unsafe fn i_eighth(a: [i32; 16]) -> [i32; 16] {
        a.map(|x| x >> 3)
    }
    #[inline(always)]
    unsafe fn i_max(a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|i| a[i].max(b[i]))
    }
    #[inline(always)]
    unsafe fn i_gather(p: *const u32, i: [i32; 16]) -> [i32; 16] {
        i.map(|i| unsafe { *p.add(i as usize) } as i32)
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
    unsafe fn q_add(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn q_sub(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn q_mul(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn q_div(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| a[i] / b[i])
    }
    #[inline(always)]
    unsafe fn q_sqrt(a: [f32; 4]) -> [f32; 4] {
        a.map(f32::sqrt)
    }
    #[inline(always)]
    unsafe fn q_max(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn q_dot(a: [f32; 4], b: [f32; 4]) -> f32 {
        (a[0] * b[0] + a[2] * b[2]) + (a[1] * b[1] + a[3] * b[3])
    }
}

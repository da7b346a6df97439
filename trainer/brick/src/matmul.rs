//! Products of tall matrices with small ones, rows in registers: the whole arithmetic of a tiny network.
#![allow(unsafe_code, reason = "unchecked access in the innermost loops; sizes are asserted at the border")]

use crate::simd::Simd;

/// y[n × OUT] = x[n × IN] · w[IN × OUT], with ReLU if asked. `n` is a multiple of 8; OUT of 16.
#[inline(always)]
pub(crate) fn product<S: Simd, const IN: usize, const OUT: usize>(
    x: &[f32],
    w: &[f32],
    y: &mut [f32],
    n: usize,
    relu: bool,
) {
    assert!(n.is_multiple_of(8) && OUT.is_multiple_of(16), "block sizes");
    assert!(x.len() >= n * IN && w.len() >= IN * OUT && y.len() >= n * OUT, "matrix sizes");
    let (x, w, y) = (x.as_ptr(), w.as_ptr(), y.as_mut_ptr());
    // SAFETY: all indices stay below the lengths asserted above.
    unsafe {
        if S::ROWS == 8 && OUT == 32 {
            for row in (0..n).step_by(8) {
                block::<S, IN, OUT, 8, 2>(x, w, y, row, 0, relu);
            }
        } else if S::ROWS == 8 {
            for row in (0..n).step_by(8) {
                for column in (0..OUT).step_by(16) {
                    block::<S, IN, OUT, 8, 1>(x, w, y, row, column, relu);
                }
            }
        } else {
            for row in (0..n).step_by(4) {
                for column in (0..OUT).step_by(16) {
                    block::<S, IN, OUT, 4, 1>(x, w, y, row, column, relu);
                }
            }
        }
    }
}

#[inline(always)]
unsafe fn block<S: Simd, const IN: usize, const OUT: usize, const R: usize, const C: usize>(
    x: *const f32,
    w: *const f32,
    y: *mut f32,
    row: usize,
    column: usize,
    relu: bool,
) {
    // SAFETY: `product` asserts the lengths, and asks for blocks inside them only.
    unsafe {
        let mut sum = [[S::splat(0.0); C]; R];
        for i in 0..IN {
            let mut weight = [S::splat(0.0); C];
            for (c, v) in weight.iter_mut().enumerate() {
                *v = S::load(w.add(i * OUT + column + c * 16));
            }
            for (r, sum) in sum.iter_mut().enumerate() {
                let value = S::splat(*x.add((row + r) * IN + i));
                for c in 0..C {
                    sum[c] = S::fma(value, weight[c], sum[c]);
                }
            }
        }
        for (r, sum) in sum.iter().enumerate() {
            for (c, &v) in sum.iter().enumerate() {
                let v = if relu { S::relu(v) } else { v };
                S::store(y.add((row + r) * OUT + column + c * 16), v);
            }
        }
    }
}

/// dw[IN × OUT] += xᵀ[IN × n] · dy[n × OUT]. IN is a multiple of 4.
#[inline(always)]
pub(crate) fn accumulate_weights<S: Simd, const IN: usize, const OUT: usize>(
    x: &[f32],
    dy: &[f32],
    dw: &mut [f32],
    n: usize,
) {
    assert!(IN.is_multiple_of(4) && OUT.is_multiple_of(16), "block sizes");
    assert!(x.len() >= n * IN && dy.len() >= n * OUT && dw.len() >= IN * OUT, "matrix sizes");
    let (x, dy, dw) = (x.as_ptr(), dy.as_ptr(), dw.as_mut_ptr());
    // SAFETY: all indices stay below the lengths asserted above.
    unsafe {
        for i in (0..IN).step_by(4) {
            for column in (0..OUT).step_by(16) {
                let mut sum = [S::splat(0.0); 4];
                for s in 0..n {
                    let d = S::load(dy.add(s * OUT + column));
                    for (r, sum) in sum.iter_mut().enumerate() {
                        *sum = S::fma(S::splat(*x.add(s * IN + i + r)), d, *sum);
                    }
                }
                for (r, &sum) in sum.iter().enumerate() {
                    let p = dw.add((i + r) * OUT + column);
                    S::store(p, S::add(S::load(p), sum));
                }
            }
        }
    }
}

/// d[i] = 0 where the activation h[i] is 0 (the gradient of ReLU). `n` is a multiple of 16.
#[inline(always)]
pub(crate) fn gate<S: Simd>(h: &[f32], d: &mut [f32], n: usize) {
    assert!(n.is_multiple_of(16) && h.len() >= n && d.len() >= n, "sizes");
    for i in (0..n).step_by(16) {
        // SAFETY: i + 16 ≤ n.
        unsafe {
            let p = d.as_mut_ptr().add(i);
            S::store(p, S::where_positive(S::load(h.as_ptr().add(i)), S::load(p)));
        }
    }
}

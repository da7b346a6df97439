//! Matrix products on row-major slices, single-threaded.

use gemm::Parallelism;

use super::scalar::Scalar;

/// A row-major matrix inside a slice: row `r` starts at `r * stride`.
#[derive(Clone, Copy)]
pub(super) struct Matrix<'a, T> {
    pub(super) values: &'a [T],
    pub(super) rows: usize,
    pub(super) cols: usize,
    pub(super) stride: usize,
}

/// A mutable row-major matrix inside a slice.
pub(super) struct MatrixMut<'a, T> {
    pub(super) values: &'a mut [T],
    pub(super) rows: usize,
    pub(super) cols: usize,
    pub(super) stride: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// Matrix with rows `stride` elements apart.
    pub(super) fn new(values: &'a [T], rows: usize, cols: usize, stride: usize) -> Self {
        assert_fits(values.len(), rows, cols, stride);
        Self { values, rows, cols, stride }
    }

    /// Matrix whose rows follow each other without a gap.
    pub(super) fn dense(values: &'a [T], rows: usize, cols: usize) -> Self {
        Self::new(values, rows, cols, cols)
    }
}

impl<'a, T> MatrixMut<'a, T> {
    /// Matrix with rows `stride` elements apart.
    pub(super) fn new(values: &'a mut [T], rows: usize, cols: usize, stride: usize) -> Self {
        assert_fits(values.len(), rows, cols, stride);
        Self { values, rows, cols, stride }
    }

    /// Matrix whose rows follow each other without a gap.
    pub(super) fn dense(values: &'a mut [T], rows: usize, cols: usize) -> Self {
        Self::new(values, rows, cols, cols)
    }
}

/// The bound every unchecked access of this module relies on.
fn assert_fits(len: usize, rows: usize, cols: usize, stride: usize) {
    let fits = rows == 0 || cols == 0 || {
        let last = (rows - 1).checked_mul(stride).and_then(|start| start.checked_add(cols));
        cols <= stride && last.is_some_and(|last| last <= len)
    };
    assert!(fits, "a {rows}x{cols} matrix with rows {stride} apart does not fit into {len} elements");
}

/// `c = a · b`, or `c += a · b` with `accumulate`.
pub(super) fn multiply<T: Scalar>(a: Matrix<T>, b: Matrix<T>, c: MatrixMut<T>, accumulate: bool) {
    assert!(a.rows == c.rows && a.cols == b.rows && b.cols == c.cols, "matrix shapes do not fit");
    let (a_strides, b_strides) = ([a.stride, 1], [b.stride, 1]);
    run([c.rows, c.cols, a.cols], a.values, a_strides, b.values, b_strides, c, accumulate);
}

/// `c += aᵀ · b`.
pub(super) fn accumulate_transposed<T: Scalar>(a: Matrix<T>, b: Matrix<T>, c: MatrixMut<T>) {
    assert!(a.cols == c.rows && a.rows == b.rows && b.cols == c.cols, "matrix shapes do not fit");
    let (a_strides, b_strides) = ([1, a.stride], [b.stride, 1]);
    run([c.rows, c.cols, a.rows], a.values, a_strides, b.values, b_strides, c, true);
}

/// `c (+)= a · b` for `[m, n, k]` and strides `[row, column]`.
#[expect(unsafe_code, reason = "gemm takes raw pointers")]
fn run<T: Scalar>(
    [m, n, k]: [usize; 3],
    a: &[T],
    [a_row, a_col]: [usize; 2],
    b: &[T],
    [b_row, b_col]: [usize; 2],
    c: MatrixMut<T>,
    accumulate: bool,
) {
    if m == 0 || n == 0 {
        return;
    }
    let MatrixMut { values: c, stride: c_row, .. } = c;
    // SAFETY: the constructors of `Matrix` and `MatrixMut` have checked that every element `row * stride + col` lies
    // inside its slice, and the callers that the three shapes agree, so gemm stays within the slices. `c` is a unique
    // borrow, hence disjoint from `a` and `b`. Strides are far below `isize::MAX`. `T` is f32 or f64, which gemm
    // supports, and with `read_dst` false `c` is only written.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            c_row as isize,
            accumulate,
            a.as_ptr(),
            a_col as isize,
            a_row as isize,
            b.as_ptr(),
            b_col as isize,
            b_row as isize,
            T::ONE,
            T::ONE,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small integers, so that every product is exact whatever the order of its summands.
    fn integers(len: usize, seed: usize) -> Vec<f32> {
        (0..len).map(|i| ((i * 31 + seed * 17) % 13) as f32 - 6.0).collect()
    }

    #[test]
    fn products_of_all_shapes_are_exact() {
        for (m, n, k) in [(1, 1, 1), (5, 3, 2), (128, 64, 37), (1, 64, 16), (128, 8, 64), (37, 100, 300), (3, 4, 0)] {
            let (a_stride, b_stride, c_stride) = (k + 3, n + 1, n + 5);
            let (a, b) = (integers(m * a_stride, 1), integers(k * b_stride, 2));
            let expected: Vec<f32> =
                (0..m * n).map(|i| (0..k).map(|l| a[i / n * a_stride + l] * b[l * b_stride + i % n]).sum()).collect();
            let mut turned = vec![0.0; k * m];
            for (l, row) in turned.chunks_exact_mut(m).enumerate() {
                for (i, value) in row.iter_mut().enumerate() {
                    *value = a[i * a_stride + l];
                }
            }
            let (a, b) = (Matrix::new(&a, m, k, a_stride), Matrix::new(&b, k, n, b_stride));
            let mut c = vec![7.0_f32; m * c_stride];
            multiply(a, b, MatrixMut::new(&mut c, m, n, c_stride), false);
            multiply(a, b, MatrixMut::new(&mut c, m, n, c_stride), true);
            accumulate_transposed(Matrix::dense(&turned, k, m), b, MatrixMut::new(&mut c, m, n, c_stride));
            for (row, expected) in c.chunks_exact(c_stride).zip(expected.chunks_exact(n)) {
                assert!(row[..n].iter().zip(expected).all(|(c, e)| *c == 3.0 * e), "{m}x{n}x{k}");
                assert!(row[n..].iter().all(|&c| c == 7.0), "{m}x{n}x{k} wrote between the rows");
            }
        }
    }

    #[test]
    #[should_panic(expected = "does not fit")]
    fn a_matrix_longer_than_its_slice_is_refused() {
        Matrix::new(&[0.0_f32; 10], 3, 4, 4);
    }
}

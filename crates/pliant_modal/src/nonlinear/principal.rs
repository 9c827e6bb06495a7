//! The positive semidefinite part of a material's tangent, in the axes of principal stretch.

use nalgebra::{Matrix3, SMatrix, SVector};

use super::{
    Hyperelastic,
    lanes::{LANES, Lane, Vector, cross, dot, eigen, scaled},
    material::PrincipalTangent,
};

/// Nine rows `L` with `L^T L` = the tangent with its negative eigenvalues raised to zero (Teran,
/// Sifakis, Irving and Fedkiw 2005), for one point in each lane. Entry `3 c + r` of a row weighs
/// the entry (r, c) of the displacement gradient.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Roots {
    pub(crate) rows: [[Lane; 9]; 9],
    /// What the entries of each row are multiples of: rows without it are zero.
    pub(crate) sizes: [Lane; 9],
    /// The smallest eigenvalue that the tangent had before, Pa.
    pub(crate) least: Lane,
}

/// Image of `x` under the matrix with these columns.
#[inline(always)]
fn turned(columns: &[Vector; 3], x: &Vector) -> Vector {
    let [a, b, c] = columns;
    [
        x[0] * a[0] + x[1] * b[0] + x[2] * c[0],
        x[0] * a[1] + x[1] * b[1] + x[2] * c[1],
        x[0] * a[2] + x[1] * b[2] + x[2] * c[2],
    ]
}

/// The unit vector along `x`, or `or` where `x` vanishes.
#[inline(always)]
fn unit(x: &Vector, or: &Vector) -> Vector {
    let length = dot(x, x).sqrt();
    let inverse = Lane::splat(1.0) / length.max(1e-300);
    let mut out = *or;
    for axis in 0..3 {
        out[axis] = length.if_less(Lane::splat(1e-150), or[axis], inverse * x[axis]);
    }
    out
}

/// The part of `x` across the unit vector `a`.
#[inline(always)]
fn across(a: &Vector, x: &Vector) -> Vector {
    let along = dot(a, x);
    [x[0] - along * a[0], x[1] - along * a[1], x[2] - along * a[2]]
}

/// The matrix `u v^T` by columns.
#[inline(always)]
fn outer(u: &Vector, v: &Vector) -> [Lane; 9] {
    let mut out = [u[0]; 9];
    for e in 0..9 {
        out[e] = u[e % 3] * v[e / 3];
    }
    out
}

/// Vectors whose squares sum to a matrix with the entries 00, 11, 22, 01, 02, 12. Returns `None`
/// unless the matrices of all lanes are safely positive definite.
#[inline(always)]
fn cholesky(a: &[Lane; 6]) -> Option<[Vector; 3]> {
    /// Least pivot, as a share of its entry of the diagonal.
    const LEAST: f64 = 1e-6;
    let zero = Lane::splat(0.0);
    let mut sound = a[0].all_above(&zero);
    let x = a[0].max(f64::MIN_POSITIVE).sqrt();
    let inverse = Lane::splat(1.0) / x;
    let first = [x, inverse * a[3], inverse * a[4]];
    let y = a[1] - first[1] * first[1];
    sound &= y.all_above(&(LEAST * a[1]));
    let y = y.max(f64::MIN_POSITIVE).sqrt();
    let second = [zero, y, (a[5] - first[1] * first[2]) / y];
    let z = a[2] - first[2] * first[2] - second[2] * second[2];
    sound &= z.all_above(&(LEAST * a[2]));
    let z = z.max(f64::MIN_POSITIVE).sqrt();
    sound.then_some([first, second, [zero, zero, z]])
}

/// Computes the roots at deformation gradients `f`, entry `3 c + r` for (r, c).
#[inline(always)]
pub(crate) fn positive_roots(law: Hyperelastic, f: &[Lane; 9]) -> Roots {
    let columns: [Vector; 3] = [[f[0], f[1], f[2]], [f[3], f[4], f[5]], [f[6], f[7], f[8]]];
    let [x, y, z] = &columns;
    let (mut values, mut v) = eigen([dot(x, x), dot(y, y), dot(z, z), dot(x, y), dot(x, z), dot(y, z)]);
    // The largest stretch comes first.
    for (a, b) in [(0, 1), (1, 2), (0, 1)] {
        let (x, y) = (values[a], values[b]);
        values[a] = x.if_less(y, y, x);
        values[b] = x.if_less(y, x, y);
        let (p, q) = (v[a], v[b]);
        for axis in 0..3 {
            v[a][axis] = x.if_less(y, q[axis], p[axis]);
            v[b][axis] = x.if_less(y, p[axis], q[axis]);
        }
    }
    v[2] = cross(&v[0], &v[1]);
    // The first two directions are the images of the two largest stretches, made orthogonal; the
    // third follows, so that a flat element has axes too.
    let image = [turned(&columns, &v[0]), turned(&columns, &v[1]), turned(&columns, &v[2])];
    let (one, zero) = (Lane::splat(1.0), Lane::splat(0.0));
    let a = unit(&image[0], &[one, zero, zero]);
    let limit = Lane::splat(0.6);
    let (near_x, far_x) = (a[0].abs().if_less(limit, one, zero), a[0].abs().if_less(limit, zero, one));
    let other = across(&a, &[near_x, far_x, zero]);
    let b = unit(&across(&a, &image[1]), &unit(&other, &[zero, zero, one]));
    let u = [a, b, cross(&a, &b)];
    let s = [dot(&u[0], &image[0]), dot(&u[1], &image[1]), dot(&u[2], &image[2])];

    let PrincipalTangent { stretch, turn, shear } = law.principal_tangent(s);
    let (mut rows, mut sizes) = ([[zero; 9]; 9], [zero; 9]);
    let mut smallest = turn[0];
    for (k, i, j) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let (ij, ji) = (outer(&u[i], &v[j]), outer(&u[j], &v[i]));
        let (t, h) = ((0.5 * turn[k]).max(0.0).sqrt(), (0.5 * shear[k]).max(0.0).sqrt());
        (sizes[3 + k], sizes[6 + k]) = (t, h);
        for e in 0..9 {
            rows[3 + k][e] = t * (ij[e] - ji[e]);
            rows[6 + k][e] = h * (ij[e] + ji[e]);
        }
        smallest = turn[k].if_less(smallest, turn[k], smallest);
        smallest = shear[k].if_less(smallest, shear[k], smallest);
    }
    let own = [outer(&u[0], &v[0]), outer(&u[1], &v[1]), outer(&u[2], &v[2])];
    let (roots, values) = match cholesky(&stretch) {
        Some(roots) => (roots, [one; 3]),
        None => {
            let (values, vectors) = eigen(stretch);
            let mut roots = vectors;
            for k in 0..3 {
                roots[k] = scaled(values[k].max(0.0).sqrt(), &vectors[k]);
            }
            (roots, values)
        }
    };
    for (k, w) in roots.iter().enumerate() {
        sizes[k] = values[k].max(0.0);
        for e in 0..9 {
            rows[k][e] = w[0] * own[0][e] + w[1] * own[1][e] + w[2] * own[2][e];
        }
        smallest = values[k].if_less(smallest, values[k], smallest);
    }
    Roots { rows, sizes, least: smallest }
}

/// Returns the tangent of a law at a displacement gradient with its negative eigenvalues raised to
/// zero, Pa. Row and column `3 c + r` belong to entry (r, c).
pub fn positive_tangent(law: Hyperelastic, h: &Matrix3<f64>) -> SMatrix<f64, 9, 9> {
    let f = Matrix3::identity() + h;
    let f: [Lane; 9] = std::array::from_fn(|e| Lane([f[e]; LANES]));
    let mut out = SMatrix::zeros();
    for row in &positive_roots(law, &f).rows {
        let row = SVector::<f64, 9>::from_fn(|e, _| row[e].0[0]);
        out += row * row.transpose();
    }
    out
}

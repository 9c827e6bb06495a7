//! Modal warping (Choi and Ko 2005): `u = R~(w) d`, where `R~` is the integral of the rotation from
//! 0 to `w`.
//!
//! `R~(w) d = d + A (w x d) + B (w x (w x d))` with `A = (1 - cos t)/t^2`, `B = (t - sin t)/t^3`,
//! `t = |w|`.

use nalgebra::{Matrix3, Vector3};

/// Number of terms of the series of `A` and `B`. They reach rounding error below `s = 1/2`, where
/// the closed forms cancel.
const TERMS: usize = 9;

/// Computes `1 / (2k + first)!` for each term `k`.
const fn inverse_factorials(first: usize) -> [f64; TERMS] {
    let mut out = [0.0; TERMS];
    let mut k = 0;
    while k < TERMS {
        let mut factorial = 1.0;
        let mut n = 2;
        while n <= 2 * k + first {
            factorial *= n as f64;
            n += 1;
        }
        out[k] = 1.0 / factorial;
        k += 1;
    }
    out
}

/// `A = sum (-s)^k / (2k + 2)!`, `B = sum (-s)^k / (2k + 3)!`.
const COEFFICIENTS: [[f64; TERMS]; 2] = [inverse_factorials(2), inverse_factorials(3)];

/// Bound of `s` below which the series count.
const SMALL: f64 = 0.5;

/// Returns `A(s)`, `B(s)` and their derivatives with respect to `s = |w|^2`.
pub(crate) fn coefficients(s: f64) -> [f64; 4] {
    if s < SMALL { series(&[s]).map(|[x]| x) } else { closed(s) }
}

/// As [`coefficients`], for several numbers side by side.
#[inline(always)]
pub(crate) fn coefficients_of<const N: usize>(s: &[f64; N]) -> [[f64; N]; 4] {
    let mut all = series(s);
    for (i, s) in s.iter().enumerate() {
        // A number that is none has closed forms that are none.
        if s.is_nan() || *s >= SMALL {
            all.iter_mut().zip(closed(*s)).for_each(|(all, one)| all[i] = one);
        }
    }
    all
}

/// Horner's rule for the values and the derivatives together.
#[inline(always)]
fn series<const N: usize>(s: &[f64; N]) -> [[f64; N]; 4] {
    let [mut a, mut b, mut da, mut db] = [[0.0; N]; 4];
    for (of_a, of_b) in COEFFICIENTS[0].iter().zip(&COEFFICIENTS[1]).rev() {
        for i in 0..N {
            (da[i], db[i]) = (-a[i] - s[i] * da[i], -b[i] - s[i] * db[i]);
            (a[i], b[i]) = (of_a - s[i] * a[i], of_b - s[i] * b[i]);
        }
    }
    [a, b, da, db]
}

fn closed(s: f64) -> [f64; 4] {
    let t = s.sqrt();
    let (sin, cos) = t.sin_cos();
    let a = (1.0 - cos) / s;
    let b = (t - sin) / (s * t);
    let da = (t * sin - 2.0 * (1.0 - cos)) / (2.0 * s * s);
    let db = (t * (1.0 - cos) - 3.0 * (t - sin)) / (2.0 * s * s * t);
    [a, b, da, db]
}

/// Returns the warped displacement `R~(w) d` (m) of a node with rotation vector `w` (rad) and
/// linear modal displacement `d` (m).
pub fn warp(w: [f64; 3], d: [f64; 3]) -> [f64; 3] {
    let (w, d) = (Vector3::from(w), Vector3::from(d));
    let [a, b, _, _] = coefficients(w.norm_squared());
    let c = w.cross(&d);
    (d + a * c + b * w.cross(&c)).into()
}

/// Returns the warped displacement and its derivatives, `(R~ d, d(R~ d)/dd = R~, d(R~ d)/dw)`. The
/// matrices are row-major.
pub fn warp_jacobian(w: [f64; 3], d: [f64; 3]) -> ([f64; 3], [[f64; 3]; 3], [[f64; 3]; 3]) {
    let (value, by_d, by_w) = warp_with_jacobian(Vector3::from(w), Vector3::from(d));
    let rows = |m: Matrix3<f64>| std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]));
    (value.into(), rows(by_d), rows(by_w))
}

pub(crate) fn warp_with_jacobian(
    w: Vector3<f64>,
    d: Vector3<f64>,
) -> (Vector3<f64>, Matrix3<f64>, Matrix3<f64>) {
    let [a, b, da, db] = coefficients(w.norm_squared());
    let wx = w.cross_matrix();
    let by_d = Matrix3::identity() + a * wx + b * wx * wx;
    let c = w.cross(&d);
    let cc = w.cross(&c);
    let by_w = -a * d.cross_matrix()
        + 2.0 * da * c * w.transpose()
        + b * (Matrix3::identity() * w.dot(&d) + w * d.transpose() - 2.0 * d * w.transpose())
        + 2.0 * db * cc * w.transpose();
    (d + a * c + b * cc, by_d, by_w)
}

/// Number of terms of the series of `A` and `B` in `s`, for single precision up to
/// [`WARP_SERIES_LIMIT`].
pub(crate) const SERIES_TERMS: usize = 9;

/// `A = sum (-s)^k / (2k+2)!`.
pub(crate) const SERIES_A: [f32; SERIES_TERMS] = [
    1.0 / 2.0,
    -1.0 / 24.0,
    1.0 / 720.0,
    -1.0 / 40_320.0,
    1.0 / 3_628_800.0,
    -1.0 / 479_001_600.0,
    1.0 / 87_178_291_200.0,
    -1.0 / 20_922_789_888_000.0,
    1.0 / 6_402_373_705_728_000.0,
];

/// `B = sum (-s)^k / (2k+3)!`.
pub(crate) const SERIES_B: [f32; SERIES_TERMS] = [
    1.0 / 6.0,
    -1.0 / 120.0,
    1.0 / 5_040.0,
    -1.0 / 362_880.0,
    1.0 / 39_916_800.0,
    -1.0 / 6_227_020_800.0,
    1.0 / 1_307_674_368_000.0,
    -1.0 / 355_687_428_096_000.0,
    1.0 / 121_645_100_408_832_000.0,
];

/// Square of half a turn. Up to this value of `s` nine terms are exact to single precision.
pub(crate) const WARP_SERIES_LIMIT: f32 = 9.87;

/// Returns `A` and `B` for any `s` in single precision.
pub(crate) fn closed_f32(s: f32) -> (f32, f32) {
    let [a, b, _, _] = coefficients(f64::from(s));
    (a as f32, b as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_the_integral_of_the_rotation() {
        // R~ is the integral over tau in [0, 1] of exp(tau [w]x). Simpson's rule on 2,000 intervals
        // has an error of 1e-13 here.
        let (w, d) = (Vector3::new(0.7, -1.9, 1.1), Vector3::new(0.3, 0.2, -0.5));
        let n = 2_000;
        let mut sum = Vector3::zeros();
        for i in 0..=n {
            let weight = if i == 0 || i == n {
                1.0
            } else if i % 2 == 1 {
                4.0
            } else {
                2.0
            };
            sum += weight * (nalgebra::Rotation3::new(w * (i as f64 / n as f64)) * d);
        }
        sum /= 3.0 * n as f64;
        let got = Vector3::from(warp(w.into(), d.into()));
        assert!((got - sum).norm() < 1e-12, "{got} against {sum}");
    }

    #[test]
    fn series_and_closed_form_meet() {
        let (below, above) = (coefficients(0.5 - 1e-12), coefficients(0.5 + 1e-12));
        for k in 0..4 {
            assert!((below[k] - above[k]).abs() < 1e-11, "coefficient {k}: {} and {}", below[k], above[k]);
        }
        for s in [0.0f32, 1e-6, 0.3, 2.0, 9.8] {
            let horner = |c: &[f32]| c.iter().rev().fold(0.0, |sum, c| sum * s + c);
            let (series, closed) = ((horner(&SERIES_A), horner(&SERIES_B)), closed_f32(s));
            assert!((series.0 - closed.0).abs() < 2e-7 && (series.1 - closed.1).abs() < 2e-7, "s = {s}");
        }
    }

    #[test]
    fn jacobian_is_the_derivative() {
        for w in [[1e-9, 0.0, 0.0], [0.2, -0.4, 0.1], [1.5, 2.0, -0.7], [5.0, -4.0, 3.0]] {
            let d = [0.3, -0.8, 0.45];
            let (_, by_d, by_w) = warp_jacobian(w, d);
            for k in 0..3 {
                let step = 1e-6;
                let (mut wp, mut wm, mut dp, mut dm) = (w, w, d, d);
                wp[k] += step;
                wm[k] -= step;
                dp[k] += step;
                dm[k] -= step;
                let (ap, am, bp, bm) = (warp(wp, d), warp(wm, d), warp(w, dp), warp(w, dm));
                for i in 0..3 {
                    assert!(((ap[i] - am[i]) / (2.0 * step) - by_w[i][k]).abs() < 1e-8, "dw at {w:?}");
                    assert!(((bp[i] - bm[i]) / (2.0 * step) - by_d[i][k]).abs() < 1e-8, "dd at {w:?}");
                }
            }
        }
    }
}

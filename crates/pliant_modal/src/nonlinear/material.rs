//! Hyperelastic laws: energy density, stress and tangent at a displacement gradient.
//!
//! All laws agree with Hooke's law for small strains, with the same Lame constants.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use serde::{Deserialize, Serialize};

use super::lanes::{Lane, Number};

/// Second derivative of the energy density by the deformation gradient, Pa. Row and column
/// `3 c + r` belong to entry (r, c).
type StressTangent = SMatrix<f64, 9, 9>;

/// Law of the elastic energy for large strains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Material {
    /// The stable neo-Hookean law of Smith, De Goes and Kim, *Stable Neo-Hookean Flesh Simulation*,
    /// ACM Trans. Graph. 37(2), 2018, eq. (14), with `I_C = |F|^2` and `J = det F`:
    ///
    /// ```text
    /// W = mu/2 (I_C - 3) + lambda/2 (J - a)^2 - mu/2 log(I_C + 1),   a = 1 + mu/lambda - mu/(4 lambda)
    /// ```
    ///
    /// Here `mu` is 4/3 of Lame's mu, and `lambda` is Lame's lambda + 5/6 of Lame's mu. The energy
    /// is finite for every deformation, also where elements are turned inside out.
    #[default]
    NeoHookean,
    /// The law of St. Venant and Kirchhoff, `W = lambda/2 (tr E)^2 + mu |E|^2` with
    /// `E = (F^T F - I) / 2`.
    ///
    /// The law is exact for large rotations. A body that is pressed collapses: the stress is
    /// largest at a stretch of `1 / sqrt 3`.
    StVenantKirchhoff,
}

impl std::fmt::Display for Material {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NeoHookean => "neo-hookean",
            Self::StVenantKirchhoff => "st-venant-kirchhoff",
        })
    }
}

impl Material {
    /// Returns the law with these Lame constants, Pa.
    pub fn with(self, lambda: f64, mu: f64) -> Hyperelastic {
        match self {
            Self::NeoHookean => {
                Hyperelastic(Law::NeoHookean { lambda: lambda + 5.0 / 6.0 * mu, mu: 4.0 / 3.0 * mu })
            }
            Self::StVenantKirchhoff => Hyperelastic(Law::StVenantKirchhoff { lambda, mu }),
        }
    }
}

/// A law with its constants, Pa.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hyperelastic(Law);

/// The neo-Hookean constants are those of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Law {
    NeoHookean { lambda: f64, mu: f64 },
    StVenantKirchhoff { lambda: f64, mu: f64 },
}

// The functions take the displacement gradient `h = F - I`. In terms of F, small strains would lose
// their digits.
impl Hyperelastic {
    /// Returns the energy density relative to rest, J/m^3.
    pub fn energy(self, h: &Matrix3<f64>) -> f64 {
        match self.0 {
            Law::NeoHookean { lambda, mu } => {
                let second = 0.5 * (h.trace().powi(2) - (h * h).trace());
                let t = 2.0 * h.trace() + h.norm_squared();
                let j = h.trace() + second + h.determinant();
                0.375 * mu * h.norm_squared() - 0.75 * mu * (second + h.determinant())
                    + 0.5 * mu * less_log(0.25 * t)
                    + 0.5 * lambda * j * j
            }
            Law::StVenantKirchhoff { lambda, mu } => {
                let e = green_strain(h);
                0.5 * lambda * e.trace().powi(2) + mu * e.norm_squared()
            }
        }
    }

    /// Returns the first Piola-Kirchhoff stress `P = dW/dF`, Pa.
    pub fn stress(self, h: &Matrix3<f64>) -> Matrix3<f64> {
        let mut entries = [0.0; 9];
        entries.copy_from_slice(h.as_slice());
        Matrix3::from_column_slice(&self.stresses(&entries))
    }

    /// The same for numbers or lanes, entry `3 c + r` for (r, c).
    #[inline(always)]
    pub(crate) fn stresses<T: Number>(self, h: &[T; 9]) -> [T; 9] {
        let one = T::of(1.0);
        let trace = h[0] + h[4] + h[8];
        let mut square = h[0] * h[0];
        for x in &h[1..] {
            square = square + *x * *x;
        }
        let mut out = *h;
        match self.0 {
            Law::NeoHookean { lambda, mu } => {
                // The cofactor of F is I + c.
                let c = cofactor_less_one(h);
                let turned = h[0] * h[0] + h[4] * h[4] + h[8] * h[8];
                let turned = turned + T::of(2.0) * (h[1] * h[3] + h[2] * h[6] + h[5] * h[7]);
                // That of h, less its trace and with its transpose.
                let bent = [c[0] + h[0] - trace, c[1] + h[3], c[2] + h[6]];
                let det = h[0] * bent[0] + h[1] * bent[1] + h[2] * bent[2];
                let j = trace + T::of(0.5) * (trace * trace - turned) + det;
                let t = trace + trace + square;
                let all = T::of(mu) * t / (T::of(16.0) + T::of(4.0) * t);
                let pressure = T::of(lambda) * j;
                for e in 0..9 {
                    let own = if e % 4 == 0 { one } else { T::of(0.0) };
                    out[e] = T::of(0.75 * mu) * (h[e] - c[e]) + all * (own + h[e]) + pressure * (own + c[e]);
                }
            }
            Law::StVenantKirchhoff { lambda, mu } => {
                let [a, b, c] = [[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], h[8]]];
                let columns = [a, b, c];
                let dot = |a: &[T; 3], b: &[T; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
                let all = T::of(lambda) * (trace + T::of(0.5) * square);
                for k in 0..3 {
                    // Column k of the second stress, and of F times it.
                    let mut s = [all; 3];
                    for i in 0..3 {
                        let strain = columns[k][i] + columns[i][k] + dot(&columns[i], &columns[k]);
                        let rest = if i == k { all } else { T::of(0.0) };
                        s[i] = rest + T::of(mu) * strain;
                    }
                    for r in 0..3 {
                        out[3 * k + r] = s[r] + (a[r] * s[0] + b[r] * s[1] + c[r] * s[2]);
                    }
                }
            }
        }
        out
    }

    /// Returns the part of the stress that is of second order in `h`, Pa.
    pub fn second_order_stress(self, h: &Matrix3<f64>) -> Matrix3<f64> {
        let (trace, square) = (h.trace(), h.norm_squared());
        match self.0 {
            Law::NeoHookean { lambda, mu } => {
                let second = 0.5 * (trace * trace - (h * h).trace());
                let all = (0.25 * square - 0.25 * trace * trace) * Matrix3::identity() + 0.5 * trace * h;
                -0.75 * mu * cofactor(h)
                    + 0.25 * mu * all
                    + lambda
                        * (second * Matrix3::identity()
                            + trace * (trace * Matrix3::identity() - h.transpose()))
            }
            Law::StVenantKirchhoff { lambda, mu } => {
                let turned = h.tr_mul(h);
                h * (lambda * trace * Matrix3::identity() + mu * (h + h.transpose()))
                    + 0.5 * lambda * square * Matrix3::identity()
                    + mu * turned
            }
        }
    }

    /// Returns the tangent `dP/dF`, Pa. It is symmetric and may be indefinite.
    pub fn tangent(self, h: &Matrix3<f64>) -> SMatrix<f64, 9, 9> {
        let f = Matrix3::identity() + h;
        match self.0 {
            Law::NeoHookean { lambda, mu } => {
                let t = 2.0 * h.trace() + h.norm_squared();
                let volume = SVector::<f64, 9>::from_column_slice(cofactor(&f).as_slice());
                let all = SVector::<f64, 9>::from_column_slice(f.as_slice());
                let mut out = StressTangent::identity() * (mu * (3.0 + t) / (4.0 + t))
                    + all * all.transpose() * (2.0 * mu / (4.0 + t).powi(2))
                    + volume * volume.transpose() * lambda;
                // The cofactor's columns are the cross products of the columns of F.
                let pressure = lambda * volume_change(h) - 0.75 * mu;
                for k in 0..3 {
                    let cross = pressure * f.column(k).cross_matrix();
                    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
                    let mut block = out.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                    block -= cross;
                    let mut block = out.fixed_view_mut::<3, 3>(3 * j, 3 * i);
                    block += cross;
                }
                out
            }
            Law::StVenantKirchhoff { lambda, mu } => {
                let e = green_strain(h);
                let s = lambda * e.trace() * Matrix3::identity() + 2.0 * mu * e;
                let mut out = StressTangent::zeros();
                for column in 0..9 {
                    let mut df = Matrix3::zeros();
                    df[column] = 1.0;
                    let product = f.transpose() * df;
                    let de = 0.5 * (product + product.transpose());
                    let ds = lambda * de.trace() * Matrix3::identity() + 2.0 * mu * de;
                    out.column_mut(column).copy_from_slice((df * s + f * ds).as_slice());
                }
                out
            }
        }
    }

    /// Returns the tangent in the axes of principal stretch at the stretches `s`.
    #[inline(always)]
    pub(crate) fn principal_tangent(self, s: [Lane; 3]) -> PrincipalTangent {
        let one = Lane::splat(1.0);
        let [a, b, c] = s;
        let [aa, bb, cc] = [a * a, b * b, c * c];
        let [ab, ac, bc] = [a * b, a * c, b * c];
        let sum = aa + bb + cc;
        match self.0 {
            Law::NeoHookean { lambda, mu } => {
                let share = one / (sum + one);
                let (all, along) = (mu * (one - share), (2.0 * mu) * (share * share));
                let p = lambda * (ab * c - one) - Lane::splat(0.75 * mu);
                let stretch = [
                    all + along * aa + lambda * (bc * bc),
                    all + along * bb + lambda * (ac * ac),
                    all + along * cc + lambda * (ab * ab),
                    p * c + along * ab + lambda * (bc * ac),
                    p * b + along * ac + lambda * (bc * ab),
                    p * a + along * bc + lambda * (ac * ab),
                ];
                let (turn, shear) = ([p * a, p * b, p * c], [-p * a, -p * b, -p * c]);
                let plus = |x: [Lane; 3]| [all + x[0], all + x[1], all + x[2]];
                PrincipalTangent { stretch, turn: plus(turn), shear: plus(shear) }
            }
            Law::StVenantKirchhoff { lambda, mu } => {
                let rest = (0.5 * lambda) * (sum - Lane::splat(3.0)) - Lane::splat(mu);
                let own = lambda + 3.0 * mu;
                let stretch = [
                    rest + own * aa,
                    rest + own * bb,
                    rest + own * cc,
                    lambda * ab,
                    lambda * ac,
                    lambda * bc,
                ];
                let [x, y, z] = [bb + cc, aa + cc, aa + bb];
                PrincipalTangent {
                    stretch,
                    turn: [rest + mu * (x - bc), rest + mu * (y - ac), rest + mu * (z - ab)],
                    shear: [rest + mu * (x + bc), rest + mu * (y + ac), rest + mu * (z + ab)],
                }
            }
        }
    }
}

/// Tangent of an isotropic law in the axes of principal stretch `F = U diag(s) V^T` (B. Smith,
/// F. De Goes and T. Kim, *Analytic Eigensystems for Isotropic Distortion Energies*, ACM Trans.
/// Graph. 38(1), 2019).
///
/// With `U^T dF V = d`, the second derivative of the energy density is
///
/// ```text
/// sum stretch_ij d_ii d_jj + sum_k (turn_k (d_ij - d_ji)^2 + shear_k (d_ij + d_ji)^2) / 2
/// ```
///
/// where `i < j` are the other two axes of `k`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PrincipalTangent {
    /// Response to changes of the stretches, Pa: the entries 00, 11, 22, 01, 02, 12.
    pub(crate) stretch: [Lane; 6],
    /// Response to turns of the pairs of axes, Pa.
    pub(crate) turn: [Lane; 3],
    /// Response to shears of the pairs of axes, Pa.
    pub(crate) shear: [Lane; 3],
}

fn green_strain(h: &Matrix3<f64>) -> Matrix3<f64> {
    0.5 * (h + h.transpose() + h.transpose() * h)
}

fn cofactor(h: &Matrix3<f64>) -> Matrix3<f64> {
    let column = |k: usize| -> Vector3<f64> { h.column(k).into() };
    let (a, b, c) = (column(0), column(1), column(2));
    Matrix3::from_columns(&[b.cross(&c), c.cross(&a), a.cross(&b)])
}

/// Returns the cofactor of `I + h` less `I`.
#[inline(always)]
fn cofactor_less_one<T: Number>(h: &[T; 9]) -> [T; 9] {
    let trace = h[0] + h[4] + h[8];
    let cross = |a: [T; 3], b: [T; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let [a, b, c] = [[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], h[8]]];
    let [x, y, z] = [cross(b, c), cross(c, a), cross(a, b)];
    [
        x[0] + trace - h[0],
        x[1] - h[3],
        x[2] - h[6],
        y[0] - h[1],
        y[1] + trace - h[4],
        y[2] - h[7],
        z[0] - h[2],
        z[1] - h[5],
        z[2] + trace - h[8],
    ]
}

/// Returns `det(I + h) - 1`.
fn volume_change(h: &Matrix3<f64>) -> f64 {
    h.trace() + 0.5 * (h.trace().powi(2) - (h * h).trace()) + h.determinant()
}

/// Returns `x - log(1 + x)`, with all digits near zero.
fn less_log(x: f64) -> f64 {
    if x.abs() < 1e-3 {
        x * x * (0.5 - x * (1.0 / 3.0 - x * (0.25 - x * (0.2 - x / 6.0))))
    } else {
        x - x.ln_1p()
    }
}

#[cfg(test)]
mod tests {
    use super::{super::positive_tangent, *};

    const LAWS: [Material; 2] = [Material::NeoHookean, Material::StVenantKirchhoff];
    const LAME: (f64, f64) = (2.5e4, 1.25e4);

    fn law(material: Material) -> Hyperelastic {
        material.with(LAME.0, LAME.1)
    }

    /// Gradients of a moderate strain, of a small one, of a squeeze and of an inversion.
    fn gradients() -> Vec<Matrix3<f64>> {
        let wild = Matrix3::new(0.2, -0.5, 0.1, 0.4, -0.3, 0.2, -0.1, 0.3, 0.25);
        let squeezed = Matrix3::from_diagonal(&[-0.6, 0.2, 0.1].into());
        vec![wild, 1e-3 * wild, squeezed, Matrix3::from_diagonal(&[-1.5, 0.1, 0.2].into())]
    }

    #[test]
    fn stress_and_tangent_are_the_derivatives_of_the_energy() {
        for material in LAWS {
            let law = law(material);
            for h in gradients() {
                let step = 1e-5;
                let (stress, tangent) = (law.stress(&h), law.tangent(&h));
                for k in 0..9 {
                    let at = |by: f64| {
                        let mut h = h;
                        h[k] += by;
                        h
                    };
                    let slope = (law.energy(&at(step)) - law.energy(&at(-step))) / (2.0 * step);
                    assert!(
                        (slope - stress[k]).abs() < 1e-4 * LAME.1 * (1e-3 + h.norm()),
                        "{material:?} {h}"
                    );
                    let slopes = (law.stress(&at(step)) - law.stress(&at(-step))) / (2.0 * step);
                    for (i, slope) in slopes.iter().enumerate() {
                        let got = tangent[(i, k)];
                        assert!(
                            (slope - got).abs() < 1e-6 * tangent.norm(),
                            "{material:?} {h}: {slope} {got}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn the_second_order_is_what_remains_when_the_odd_orders_cancel() {
        for material in LAWS {
            let law = law(material);
            for h in gradients() {
                let h = h * (1e-4 / h.norm());
                let even = 0.5 * (law.stress(&h) + law.stress(&-h));
                let got = law.second_order_stress(&h);
                assert!((got - even).norm() < 1e-5 * even.norm(), "{material:?} {got} {even}");
            }
        }
    }

    #[test]
    fn small_strains_are_hookes_and_turns_cost_nothing() {
        let (lambda, mu) = LAME;
        for material in LAWS {
            let law = law(material);
            let h = 1e-9 * gradients()[0];
            let strain = 0.5 * (h + h.transpose());
            let hooke = lambda * strain.trace() * Matrix3::identity() + 2.0 * mu * strain;
            assert!((law.stress(&h) - hooke).norm() < 1e-7 * hooke.norm(), "{material:?}");
            let energy = 0.5 * lambda * strain.trace().powi(2) + mu * strain.norm_squared();
            assert!((law.energy(&h) / energy - 1.0).abs() < 1e-6, "{material:?}");
            let turn = nalgebra::Rotation3::from_euler_angles(0.7, -1.1, 2.0);
            let turned = turn.matrix() - Matrix3::identity();
            assert!(law.stress(&turned).norm() < 1e-10 * mu && law.energy(&turned).abs() < 1e-10 * mu);
        }
    }

    #[test]
    fn a_raised_tangent_is_positive_and_a_positive_one_stays() {
        for material in LAWS {
            let law = law(material);
            let rest = law.tangent(&Matrix3::zeros());
            assert!((positive_tangent(law, &Matrix3::zeros()) - rest).norm() < 1e-9 * rest.norm());
            let turned = nalgebra::Rotation3::from_euler_angles(0.7, -1.1, 2.0);
            let flat = Matrix3::from_diagonal(&[0.3, -1.0, -1.0].into());
            let turn = |h: Matrix3<f64>| turned * (h + Matrix3::identity()) - Matrix3::identity();
            for h in gradients().into_iter().chain(gradients().into_iter().map(turn)).chain([flat]) {
                // The nearest positive semidefinite matrix, from the eigenvalues of the tangent.
                let eigen = law.tangent(&h).symmetric_eigen();
                let up = StressTangent::from_diagonal(&eigen.eigenvalues.map(|x| x.max(0.0)));
                let want = eigen.eigenvectors * up * eigen.eigenvectors.transpose();
                let off = (positive_tangent(law, &h) - want).norm() / want.norm();
                assert!(off < 1e-9, "{material:?} {h}: {off}");
            }
        }
    }
}

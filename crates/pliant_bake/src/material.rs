//! Hyperelastic laws: energy density, stress and tangent at a displacement gradient.
//!
//! All laws agree with Hooke's law for small strains, with the same Lame constants.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Second derivative of the energy density by the deformation gradient, Pa. Row and column
/// `3 c + r` belong to entry (r, c).
pub(crate) type Tangent = SMatrix<f64, 9, 9>;

/// Law of the elastic energy for large strains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
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

impl Material {
    /// Returns the law with these Lame constants, Pa.
    pub(crate) fn with(self, lambda: f64, mu: f64) -> Hyperelastic {
        match self {
            Self::NeoHookean => {
                Hyperelastic::NeoHookean { lambda: lambda + 5.0 / 6.0 * mu, mu: 4.0 / 3.0 * mu }
            }
            Self::StVenantKirchhoff => Hyperelastic::StVenantKirchhoff { lambda, mu },
        }
    }
}

/// A law with its constants, Pa. The neo-Hookean constants are those of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Hyperelastic {
    NeoHookean { lambda: f64, mu: f64 },
    StVenantKirchhoff { lambda: f64, mu: f64 },
}

// The functions take the displacement gradient `h = F - I`. In terms of F, small strains would lose
// their digits.
impl Hyperelastic {
    /// Returns the energy density relative to rest, J/m^3.
    pub(crate) fn energy(self, h: &Matrix3<f64>) -> f64 {
        match self {
            Self::NeoHookean { lambda, mu } => {
                let second = 0.5 * (h.trace().powi(2) - (h * h).trace());
                let t = 2.0 * h.trace() + h.norm_squared();
                let j = h.trace() + second + h.determinant();
                0.375 * mu * h.norm_squared() - 0.75 * mu * (second + h.determinant())
                    + 0.5 * mu * less_log(0.25 * t)
                    + 0.5 * lambda * j * j
            }
            Self::StVenantKirchhoff { lambda, mu } => {
                let e = green_strain(h);
                0.5 * lambda * e.trace().powi(2) + mu * e.norm_squared()
            }
        }
    }

    /// Returns the first Piola-Kirchhoff stress `P = dW/dF`, Pa.
    pub(crate) fn stress(self, h: &Matrix3<f64>) -> Matrix3<f64> {
        let f = Matrix3::identity() + h;
        match self {
            Self::NeoHookean { lambda, mu } => {
                let t = 2.0 * h.trace() + h.norm_squared();
                // The cofactor of F is I + c.
                let c = h.trace() * Matrix3::identity() - h.transpose() + cofactor(h);
                let j = volume_change(h);
                0.75 * mu * (h - c) + mu * t / (4.0 * (4.0 + t)) * f + lambda * j * (Matrix3::identity() + c)
            }
            Self::StVenantKirchhoff { lambda, mu } => {
                let e = green_strain(h);
                f * (lambda * e.trace() * Matrix3::identity() + 2.0 * mu * e)
            }
        }
    }

    /// Returns the tangent `dP/dF`, Pa. It is symmetric and may be indefinite.
    pub(crate) fn tangent(self, h: &Matrix3<f64>) -> Tangent {
        let f = Matrix3::identity() + h;
        match self {
            Self::NeoHookean { lambda, mu } => {
                let t = 2.0 * h.trace() + h.norm_squared();
                let volume = SVector::<f64, 9>::from_column_slice(cofactor(&f).as_slice());
                let all = SVector::<f64, 9>::from_column_slice(f.as_slice());
                let mut out = Tangent::identity() * (mu * (3.0 + t) / (4.0 + t))
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
            Self::StVenantKirchhoff { lambda, mu } => {
                let e = green_strain(h);
                let s = lambda * e.trace() * Matrix3::identity() + 2.0 * mu * e;
                let mut out = Tangent::zeros();
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
}

/// Raises the negative eigenvalues of a tangent to zero. What it is used for then stays positive
/// semidefinite (Teran, Sifakis, Irving and Fedkiw 2005).
pub(crate) fn positive(tangent: &Tangent) -> Tangent {
    let eigen = tangent.symmetric_eigen();
    if eigen.eigenvalues.iter().all(|&x| x >= 0.0) {
        return *tangent;
    }
    let raised = SMatrix::<f64, 9, 9>::from_diagonal(&eigen.eigenvalues.map(|x| x.max(0.0)));
    eigen.eigenvectors * raised * eigen.eigenvectors.transpose()
}

fn green_strain(h: &Matrix3<f64>) -> Matrix3<f64> {
    0.5 * (h + h.transpose() + h.transpose() * h)
}

fn cofactor(h: &Matrix3<f64>) -> Matrix3<f64> {
    let column = |k: usize| -> Vector3<f64> { h.column(k).into() };
    let (a, b, c) = (column(0), column(1), column(2));
    Matrix3::from_columns(&[b.cross(&c), c.cross(&a), a.cross(&b)])
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
    use super::*;

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
            let rest = law(material).tangent(&Matrix3::zeros());
            assert!((positive(&rest) - rest).norm() < 1e-9 * rest.norm());
            for h in gradients() {
                let raised = positive(&law(material).tangent(&h));
                let least = raised.symmetric_eigenvalues().min();
                assert!(least > -1e-9 * raised.norm(), "{material:?} {h}: {least}");
            }
        }
    }
}

//! Element matrices of straight-sided 4-node and 10-node tetrahedra for linear elasticity.
//!
//! Both elements are affine, so the barycentric gradients are constant and every integral below is
//! exact. The stiffness integrand is at most quadratic and is integrated by a 4-point rule of
//! degree 2. The mass integrand is a polynomial in the barycentric coordinates and is integrated in
//! closed form by `int L1^a L2^b L3^c L4^d dV = 6 V a! b! c! d! / (a+b+c+d+3)!`.

use pliant_modal::Element;
use pliant_modal::tetrahedron::{Affine, EDGES, MAX_NODES, dot, stiffness_points};

/// Stiffness of one element as 3x3 blocks, row by row: block (i, j) is at
/// `(i * MAX_NODES + j) * 9`.
pub(crate) type Stiffness = [f64; MAX_NODES * MAX_NODES * 9];

/// Computes the element stiffness with the Lame constants `lambda` and `mu` (Pa), N/m.
///
/// The equation is `K_ij[k][l] =`
/// `int lambda d_k N_i d_l N_j + mu (d_l N_i d_k N_j + delta_kl grad N_i . grad N_j) dV`.
pub(crate) fn stiffness(element: Element, affine: &Affine, lambda: f64, mu: f64, out: &mut Stiffness) {
    let nodes = element.node_count();
    out.fill(0.0);
    let (points, weight) = stiffness_points(element);
    for &point in points {
        let g = affine.shape_gradients(element, point);
        let w = weight * affine.volume;
        for i in 0..nodes {
            for j in i..nodes {
                let block = &mut out[(i * MAX_NODES + j) * 9..][..9];
                let shear = mu * w * dot(g[i], g[j]);
                for k in 0..3 {
                    for l in 0..3 {
                        block[3 * k + l] += w * (lambda * g[i][k] * g[j][l] + mu * g[i][l] * g[j][k]);
                    }
                    block[4 * k] += shear;
                }
            }
        }
    }
    for i in 0..nodes {
        for j in 0..i {
            for k in 0..3 {
                for l in 0..3 {
                    out[(i * MAX_NODES + j) * 9 + 3 * k + l] = out[(j * MAX_NODES + i) * 9 + 3 * l + k];
                }
            }
        }
    }
}

/// Returns `int N_a^lin grad N_i dV` for the four corners `a`, m^2. The nodal-averaged pressure
/// uses these integrals.
pub(crate) fn pressure_gradients(element: Element, affine: &Affine) -> [[[f64; 3]; MAX_NODES]; 4] {
    let mut out = [[[0.0; 3]; MAX_NODES]; 4];
    let (points, weight) = stiffness_points(element);
    for &point in points {
        let g = affine.shape_gradients(element, point);
        for a in 0..4 {
            let w = weight * affine.volume * point[a];
            for i in 0..element.node_count() {
                for k in 0..3 {
                    out[a][i][k] += w * g[i][k];
                }
            }
        }
    }
    out
}

/// Returns the consistent mass of an element of unit density and unit volume: entry (i, j) is at
/// `i * MAX_NODES + j`.
///
/// The matrix is the same for every affine element up to the factor density x volume, and acts on
/// each axis alike.
pub(crate) fn unit_mass(element: Element) -> [f64; MAX_NODES * MAX_NODES] {
    let mut out = [0.0; MAX_NODES * MAX_NODES];
    for i in 0..element.node_count() {
        for j in 0..element.node_count() {
            let mut sum = 0.0;
            for (ci, ei) in monomials(element, i) {
                for (cj, ej) in monomials(element, j) {
                    let e: [usize; 4] = [0, 1, 2, 3].map(|k| ei[k] + ej[k]);
                    let numerator: f64 = e.iter().map(|&k| factorial(k)).product();
                    sum += ci * cj * 6.0 * numerator / factorial(e.iter().sum::<usize>() + 3);
                }
            }
            out[i * MAX_NODES + j] = sum;
        }
    }
    out
}

/// Returns a shape function as (coefficient, exponents of the barycentric coordinates) terms.
fn monomials(element: Element, node: usize) -> Vec<(f64, [usize; 4])> {
    let power = |a: usize, n: usize| {
        let mut e = [0; 4];
        e[a] = n;
        e
    };
    match element {
        Element::Tet4 => vec![(1.0, power(node, 1))],
        Element::Tet10 if node < 4 => vec![(2.0, power(node, 2)), (-1.0, power(node, 1))],
        Element::Tet10 => {
            let [a, b] = EDGES[node - 4];
            let mut e = power(a, 1);
            e[b] = 1;
            vec![(4.0, e)]
        }
    }
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

#[cfg(test)]
mod tests {
    use pliant_modal::tetrahedron::cross;

    use super::*;

    const SKEW: [[f64; 3]; 4] = [[0.1, 0.0, -0.2], [1.3, 0.2, 0.1], [0.3, 0.9, 0.0], [0.2, 0.1, 1.1]];

    #[test]
    fn mass_of_the_linear_element_is_v_over_20_times_one_plus_delta() {
        let m = unit_mass(Element::Tet4);
        for i in 0..4 {
            for j in 0..4 {
                let expected = if i == j { 0.1 } else { 0.05 };
                assert!((m[i * MAX_NODES + j] - expected).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn mass_sums_to_one_and_gives_linear_fields_their_exact_second_moment() {
        for element in [Element::Tet4, Element::Tet10] {
            let m = unit_mass(element);
            let affine = Affine::new(SKEW);
            let position = |i: usize| {
                if i < 4 {
                    SKEW[i]
                } else {
                    let [a, b] = EDGES[i - 4];
                    [0, 1, 2].map(|k| 0.5 * (SKEW[a][k] + SKEW[b][k]))
                }
            };
            let n = element.node_count();
            let (mut total, mut xx) = (0.0, 0.0);
            for i in 0..n {
                for j in 0..n {
                    total += m[i * MAX_NODES + j];
                    xx += m[i * MAX_NODES + j] * position(i)[0] * position(j)[0];
                }
            }
            // The exact integral over a simplex is int x^2 = V/20 (sum x_i^2 + (sum x_i)^2).
            let s: f64 = SKEW.iter().map(|p| p[0]).sum();
            let s2: f64 = SKEW.iter().map(|p| p[0] * p[0]).sum();
            assert!((total - 1.0).abs() < 1e-14, "{element:?}");
            assert!((xx - (s2 + s * s) / 20.0).abs() < 1e-14, "{element:?}");
            assert!(affine.volume > 0.0);
        }
    }

    #[test]
    fn stiffness_is_symmetric_kills_rigid_motion_and_gives_the_energy_of_uniform_strain() {
        let affine = Affine::new(SKEW);
        let (lambda, mu) = (1.7, 0.9);
        for element in [Element::Tet4, Element::Tet10] {
            let n = element.node_count();
            let mut k = [0.0; MAX_NODES * MAX_NODES * 9];
            stiffness(element, &affine, lambda, mu, &mut k);
            let position = |i: usize| {
                if i < 4 {
                    SKEW[i]
                } else {
                    let [a, b] = EDGES[i - 4];
                    [0, 1, 2].map(|k| 0.5 * (SKEW[a][k] + SKEW[b][k]))
                }
            };
            let energy = |field: &dyn Fn([f64; 3]) -> [f64; 3]| {
                let mut sum = 0.0;
                for i in 0..n {
                    for j in 0..n {
                        let (u, v) = (field(position(i)), field(position(j)));
                        for a in 0..3 {
                            for b in 0..3 {
                                sum += u[a] * k[(i * MAX_NODES + j) * 9 + 3 * a + b] * v[b];
                            }
                        }
                    }
                }
                sum
            };
            assert!(energy(&|_| [1.0, 2.0, 3.0]).abs() < 1e-12, "translation, {element:?}");
            assert!(energy(&|p| cross([0.3, -0.7, 0.2], p)).abs() < 1e-12, "rotation, {element:?}");
            // The energy density is lambda + 2 mu for u = (x, 0, 0) and mu for u = (y, 0, 0).
            let stretch = energy(&|p| [p[0], 0.0, 0.0]) / affine.volume;
            let shear = energy(&|p| [p[1], 0.0, 0.0]) / affine.volume;
            assert!((stretch - (lambda + 2.0 * mu)).abs() < 1e-12, "{stretch}, {element:?}");
            assert!((shear - mu).abs() < 1e-12, "{shear}, {element:?}");
        }
    }
}

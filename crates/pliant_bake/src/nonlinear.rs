//! Geometrically nonlinear static solution of an anchored body under dead loads, as a reference for
//! the warped modes.
//!
//! The method is total Lagrangian finite elements with the St. Venant-Kirchhoff law
//! `S = lambda tr(E) I + 2 mu E`, `E = (F^T F - I) / 2`. The moduli are those of the bake. The law
//! is exact for large rotations and valid while strains stay moderate. Newton's method runs in load
//! increments. The tangent is
//!
//! ```text
//! K_ij = int (g_i . S g_j) I + lambda a_i a_j^T + mu ((g_i . g_j) F F^T + a_j a_i^T) dV,   a = F g, g = grad N at rest
//! ```
//!
//! (J. Bonet and R. D. Wood, *Nonlinear Continuum Mechanics for Finite Element Analysis*, 2nd ed.
//! 2008, ch. 9). The solver serves the validation report. Games do not need it at run time.

use nalgebra::{Matrix3, Vector3};
use pliant_mesh::TetMesh;
use pliant_modal::Patch;
use rayon::prelude::*;

use crate::bake::{elimination_order, law};
use crate::element::{self, Element, MAX_NODES};
use crate::factor::Factor;
use crate::fem::{ANCHORED, FeMesh, Law};
use crate::sparse::BlockCsr;
use crate::surface::Skin;
use crate::symbolic::Symbolic;
use crate::{BakeConfig, BakeError, support};

/// Number of Newton iterations in one increment before the increment is halved.
const ROUNDS: usize = 12;

/// Residual force, as a fraction of the load, at which an increment has converged.
const TOLERANCE: f64 = 1e-8;

/// Smallest increment, as a fraction of the whole load. Below it the solver gives up, because the
/// body has no stable shape there.
const SMALLEST: f64 = 1e-3;

/// Force of constant direction on a patch of the body's own surface (the boundary of the
/// tetrahedra).
#[derive(Clone, Debug)]
pub struct DeadLoad {
    /// Patch whose weights distribute the force.
    pub patch: Patch,
    /// Force, N.
    pub force: [f64; 3],
}

/// Static equilibrium of a body under its loads.
#[derive(Clone, Debug)]
pub struct Deflection {
    /// Displacement of each vertex of the tetrahedra's boundary, m, in the order of the baked
    /// surface.
    pub surface: Vec<[f64; 3]>,
    /// Displacement of each vertex by the linear theory, m, in the same order.
    pub linear: Vec<[f64; 3]>,
    /// Displacement of each loaded patch, m.
    pub patches: Vec<[f64; 3]>,
    /// Total number of Newton iterations.
    pub rounds: usize,
    /// Remaining |load - inner forces| / |load|, at most 1e-8, or 0 without a load.
    ///
    /// This is the error of the result as a solution on its mesh.
    pub residual: f64,
}

/// Solves for the shape of an anchored body under dead loads.
///
/// # Errors
/// Returns the errors of [`bake`](crate::bake()) for the mesh, the material and the anchors.
/// Returns [`BakeError::Parameter`] for a Poisson ratio above 0.45 (the nodal pressure has no
/// nonlinear form here), for a body without anchors, and when no stable shape is found ("load").
pub fn deflect(mesh: &TetMesh, config: &BakeConfig, loads: &[DeadLoad]) -> Result<Deflection, BakeError> {
    config.check()?;
    let refuse = |name, expected, got| Err(BakeError::Parameter { name, expected, got });
    if config.poisson > 0.45 {
        return refuse("Poisson ratio", "at most 0.45 for a nonlinear solution", config.poisson);
    }
    if config.anchors.is_empty() {
        return refuse("anchors", "at least one for a nonlinear solution", 0.0);
    }
    mesh.check().map_err(BakeError::Mesh)?;
    let mut mesh = mesh.clone();
    mesh.drop_unused_nodes();
    let element = match config.element {
        pliant_modal::Element::Tet4 => Element::Tet4,
        _ => Element::Tet10,
    };
    let fe = FeMesh::new(&mesh, element);
    let held = support::anchored_nodes(&fe, &config.anchors)?;
    let graph = fe.graph(false);
    support::check_connected(&fe, &graph, &held, &config.anchors)?;
    let (number, ordered) = elimination_order(&fe, &graph, &held);
    let skin = Skin::new(&mesh, &fe, None, &number)?;
    let dofs = 3 * number.iter().filter(|&&row| row != ANCHORED).count();
    let mut load = vec![0.0; dofs];
    let mut spread: Vec<Vec<(u32, f64)>> = Vec::new();
    for dead in loads {
        let mut places = Vec::new();
        for &(vertex, weight) in dead.patch.entries() {
            skin.spread(vertex, weight, &mut |node, share| places.push((number[node as usize], share)));
        }
        for &(row, share) in places.iter().filter(|(row, _)| *row != ANCHORED) {
            for axis in 0..3 {
                load[3 * row as usize + axis] += share * dead.force[axis];
            }
        }
        spread.push(places);
    }
    let problem = Problem { fe: &fe, law: law(config), number: &number, ordered: &ordered };
    let symbolic = Symbolic::new(&ordered);
    let size = norm(&load);

    let mut linear = load.clone();
    let (matrix, _) = problem.tangent(&vec![0.0; dofs]);
    factor(&symbolic, &matrix).ok_or(no_shape(0.0))?.solve(&mut linear, 1);

    let mut u = vec![0.0; dofs];
    let (mut done, mut increment, mut rounds) = (0.0, 0.25f64, 0);
    let mut residual_left = 0.0;
    while done < 1.0 && size > 0.0 {
        let next = (done + increment).min(1.0);
        let mut trial = u.clone();
        let mut converged = false;
        for _ in 0..ROUNDS {
            rounds += 1;
            let (matrix, inner) = problem.tangent(&trial);
            let mut residual: Vec<f64> = load.iter().zip(&inner).map(|(f, i)| next * f - i).collect();
            let left = norm(&residual);
            if !left.is_finite() {
                break;
            }
            if left <= TOLERANCE * size {
                residual_left = left / size;
                converged = true;
                break;
            }
            let Some(factor) = factor(&symbolic, &matrix) else { break };
            factor.solve(&mut residual, 1);
            trial.iter_mut().zip(&residual).for_each(|(u, du)| *u += du);
        }
        if converged {
            u = trial;
            done = next;
            increment *= 1.5;
        } else {
            increment *= 0.5;
            if increment < SMALLEST {
                return Err(no_shape(done));
            }
        }
    }
    let node = |values: &[f64], row: u32| -> [f64; 3] {
        std::array::from_fn(|k| if row == ANCHORED { 0.0 } else { values[3 * row as usize + k] })
    };
    let at_surface = |values: &[f64]| -> Vec<[f64; 3]> {
        (0..skin.mesh.positions().len() as u32)
            .map(|vertex| {
                let mut sum = [0.0; 3];
                skin.spread(vertex, 1.0, &mut |n, share| {
                    let at = node(values, number[n as usize]);
                    (0..3).for_each(|k| sum[k] += share * at[k]);
                });
                sum
            })
            .collect()
    };
    let patches = spread
        .iter()
        .map(|places| {
            places.iter().fold([0.0; 3], |sum, &(row, share)| {
                let at = node(&u, row);
                std::array::from_fn(|k| sum[k] + share * at[k])
            })
        })
        .collect();
    let (surface, linear) = (at_surface(&u), at_surface(&linear));
    Ok(Deflection { surface, linear, patches, rounds, residual: residual_left })
}

fn no_shape(done: f64) -> BakeError {
    BakeError::Parameter { name: "load", expected: "one under which the body has a stable shape", got: done }
}

fn factor(symbolic: &Symbolic, matrix: &BlockCsr) -> Option<Factor> {
    Factor::new(symbolic.clone(), matrix, &[]).ok()
}

fn norm(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

struct Problem<'a> {
    fe: &'a FeMesh,
    law: Law,
    number: &'a [u32],
    ordered: &'a crate::fem::Lists,
}

type Blocks = [f64; MAX_NODES * MAX_NODES * 9];

impl Problem<'_> {
    /// Returns the tangent stiffness and the inner forces at a displacement.
    fn tangent(&self, u: &[f64]) -> (BlockCsr, Vec<f64>) {
        const BATCH: usize = 512;
        let per = self.fe.element.node_count();
        let mut out = BlockCsr::zeros(self.ordered);
        let mut inner = vec![0.0; u.len()];
        let mut batch = vec![([0.0; MAX_NODES * MAX_NODES * 9], [[0.0; 3]; MAX_NODES]); BATCH];
        for (index, affine) in self.fe.affine.chunks(BATCH).enumerate() {
            let nodes_of = |local: usize| &self.fe.connectivity[(index * BATCH + local) * per..][..per];
            batch[..affine.len()].par_iter_mut().enumerate().for_each(|(local, (k, f))| {
                let nodes = nodes_of(local);
                let mut at = [Vector3::zeros(); MAX_NODES];
                for (at, &node) in at.iter_mut().zip(nodes) {
                    let row = self.number[node as usize];
                    if row != ANCHORED {
                        *at = Vector3::from_fn(|axis, _| u[3 * row as usize + axis]);
                    }
                }
                self.element(&affine[local], &at[..per], k, f);
            });
            for (local, (k, f)) in batch[..affine.len()].iter().enumerate() {
                let nodes = nodes_of(local);
                for (i, &a) in nodes.iter().enumerate() {
                    let row = self.number[a as usize];
                    if row == ANCHORED {
                        continue;
                    }
                    (0..3).for_each(|axis| inner[3 * row as usize + axis] += f[i][axis]);
                    for (j, &b) in nodes.iter().enumerate() {
                        let column = self.number[b as usize];
                        if column != ANCHORED {
                            let at = out.position(row, column);
                            let block = &k[(i * MAX_NODES + j) * 9..][..9];
                            out.stiffness[9 * at..][..9]
                                .iter_mut()
                                .zip(block)
                                .for_each(|(to, from)| *to += from);
                        }
                    }
                }
            }
        }
        (out, inner)
    }

    fn element(
        &self,
        affine: &element::Affine,
        u: &[Vector3<f64>],
        k: &mut Blocks,
        f: &mut [[f64; 3]; MAX_NODES],
    ) {
        let Law { lambda, mu, .. } = self.law;
        k.fill(0.0);
        *f = [[0.0; 3]; MAX_NODES];
        let (points, share) = element::stiffness_points(self.fe.element);
        for &point in points {
            let g: Vec<Vector3<f64>> = affine.shape_gradients(self.fe.element, point)[..u.len()]
                .iter()
                .map(|g| Vector3::from(*g))
                .collect();
            let w = share * affine.volume;
            // The strain is computed from the displacement gradient, because `F^T F - I` would
            // leave small strains no digits.
            let h = u.iter().zip(&g).fold(Matrix3::zeros(), |sum, (u, g)| sum + u * g.transpose());
            let deformation = Matrix3::identity() + h;
            let strain = 0.5 * (h + h.transpose() + h.transpose() * h);
            let stress = lambda * strain.trace() * Matrix3::identity() + 2.0 * mu * strain;
            let left = deformation * deformation.transpose();
            let a: Vec<Vector3<f64>> = g.iter().map(|g| deformation * g).collect();
            for i in 0..u.len() {
                let force = w * (deformation * (stress * g[i]));
                (0..3).for_each(|axis| f[i][axis] += force[axis]);
                let pulled = stress * g[i];
                for j in 0..u.len() {
                    let block = w
                        * (Matrix3::identity() * pulled.dot(&g[j])
                            + lambda * a[i] * a[j].transpose()
                            + mu * (g[i].dot(&g[j]) * left + a[j] * a[i].transpose()));
                    for row in 0..3 {
                        for column in 0..3 {
                            k[(i * MAX_NODES + j) * 9 + 3 * row + column] += block[(row, column)];
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use pliant_mesh::shapes;
    use pliant_modal::SurfaceMesh;

    use super::*;

    /// Solves a slender cantilever under a dead load `p` = P L^2 / (E I) across its end.
    ///
    /// The cantilever is 1 m long and a thirtieth of that thick, with nu = 0.
    fn cantilever(p: f64) -> [f64; 3] {
        let thick = 1.0 / 30.0;
        let mesh = shapes::bar([30, 1, 1], [1.0, thick, thick]).unwrap();
        let config = BakeConfig {
            young: 1e6,
            poisson: 0.0,
            anchors: vec!["x<1e-9".parse().unwrap()],
            ..BakeConfig::default()
        };
        let (surface, _) = mesh.boundary();
        let positions = surface.positions.iter().map(|p| p.map(|x| x as f32)).collect::<Vec<_>>();
        let count = positions.len();
        let surface =
            SurfaceMesh::new(positions.clone(), surface.triangles, None, vec![false; count]).unwrap();
        let stiffness = 1e6 * thick.powi(4) / 12.0;
        let corners: Vec<u32> = (0..count as u32).filter(|&v| positions[v as usize][0] > 0.999).collect();
        let loads: Vec<DeadLoad> = corners
            .iter()
            .map(|&v| DeadLoad {
                patch: Patch::around(&surface, v, 0.0).unwrap(),
                force: [0.0, p * stiffness / corners.len() as f64, 0.0],
            })
            .collect();
        let solved = deflect(&mesh, &config, &loads).unwrap();
        let count = solved.patches.len() as f64;
        std::array::from_fn(|k| solved.patches.iter().map(|p| p[k]).sum::<f64>() / count)
    }

    #[test]
    fn a_slender_cantilever_bends_as_the_elastica() {
        // The values are v / L and u / L of the elastica (Bisshopp and Drucker 1945). A bar of
        // aspect ratio 30 also shears, by 3 E I / (k G A L^2) ~ 0.3 % of v.
        for (p, v, u) in [(1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064)] {
            let tip = cantilever(p);
            assert!((tip[1] / v - 1.0).abs() < 0.01, "P L^2 / E I = {p}: {tip:?}");
            assert!((-tip[0] / u - 1.0).abs() < 0.02, "P L^2 / E I = {p}: {tip:?}");
        }
    }

    #[test]
    fn a_small_load_gives_the_linear_solution() {
        let mesh = shapes::bar([4, 1, 1], [1.0, 0.25, 0.25]).unwrap();
        let config = BakeConfig { anchors: vec!["x<1e-9".parse().unwrap()], ..BakeConfig::default() };
        let (surface, _) = mesh.boundary();
        let positions: Vec<[f32; 3]> = surface.positions.iter().map(|p| p.map(|x| x as f32)).collect();
        let count = positions.len();
        let surface = SurfaceMesh::new(positions, surface.triangles, None, vec![false; count]).unwrap();
        let patch = Patch::around(&surface, count as u32 - 1, 0.0).unwrap();
        let solved = deflect(&mesh, &config, &[DeadLoad { patch, force: [0.0, 1e-4, 2e-4] }]).unwrap();
        assert!(solved.residual > 0.0 && solved.residual <= 1e-8, "{}", solved.residual);
        let largest = solved.linear.iter().flatten().fold(0.0f64, |m, x| m.max(x.abs()));
        for (a, b) in solved.surface.iter().flatten().zip(solved.linear.iter().flatten()) {
            assert!((a - b).abs() < 1e-4 * largest, "{a} and {b}");
        }
    }

    #[test]
    fn what_it_cannot_solve_is_refused() {
        let mesh = shapes::bar([2, 1, 1], [1.0, 0.5, 0.5]).unwrap();
        let free = BakeConfig::default();
        assert!(matches!(deflect(&mesh, &free, &[]), Err(BakeError::Parameter { name: "anchors", .. })));
        let held = BakeConfig { poisson: 0.49, anchors: vec!["x<1e-9".parse().unwrap()], ..free };
        assert!(matches!(
            deflect(&mesh, &held, &[]),
            Err(BakeError::Parameter { name: "Poisson ratio", .. })
        ));
    }
}

//! Nonlinear static solution of a body under loads and prescribed displacements: the reference for
//! the force in the hand.
//!
//! The method is total Lagrangian finite elements with a hyperelastic [`Material`] whose moduli are
//! those of the bake (J. Bonet and R. D. Wood, *Nonlinear Continuum Mechanics for Finite Element
//! Analysis*, 2nd ed. 2008, ch. 9):
//!
//! ```text
//! f_i = int P g_i dV,   K_ij = int sum_cd g_i[c] g_j[d] (dP/dF)_cd dV,   g = grad N at rest
//! ```
//!
//! Newton's method runs in increments of the whole load. Where the tangent is not positive
//! definite, the negative eigenvalues of each quadrature point are raised to zero. A line search on
//! the potential energy keeps the iteration from leaving the stable shape. Prescribed displacements
//! are linear constraints with multipliers; the multipliers are the forces. Games do not need this
//! solver at run time.

use nalgebra::{DMatrix, DVector};
use pliant_mesh::TetMesh;
use pliant_modal::tetrahedron::MAX_NODES;
use pliant_modal::{Element, Material, Patch};
use rayon::prelude::*;

use crate::bake::{elimination_order, law};
use crate::continuum::Continuum;
use crate::factor::Factor;
use crate::fem::{ANCHORED, FeMesh};
use crate::sparse::BlockCsr;
use crate::surface::Skin;
use crate::symbolic::Symbolic;
use crate::{BakeConfig, BakeError, region, support};

/// Number of Newton iterations in one increment before the increment is halved.
const ROUNDS: usize = 100;

/// Residual force, as a fraction of the load, at which an increment has converged.
const TOLERANCE: f64 = 1e-8;

/// Share by which the diagonal of a free body's tangent is raised.
const LOOSE: f64 = 1e-8;

/// Smallest increment, as a fraction of the whole load. Below it the solver gives up, because the
/// body has no stable shape there.
const SMALLEST: f64 = 1e-3;

/// Number of halvings in a line search.
const HALVINGS: usize = 12;

/// Force of constant direction on a patch of the body's own surface (the boundary of the
/// tetrahedra).
#[derive(Clone, Debug)]
pub struct DeadLoad {
    /// Patch whose weights distribute the force.
    pub patch: Patch,
    /// Force, N.
    pub force: [f64; 3],
}

/// A patch of the body's own surface that is held at a place.
#[derive(Clone, Debug)]
pub struct PrescribedPatch {
    /// Patch whose mean displacement is prescribed in all three directions.
    pub patch: Patch,
    /// Displacement from rest, m.
    pub displacement: [f64; 3],
}

/// What acts on a body at rest.
#[derive(Clone, Copy, Debug, Default)]
pub struct StaticLoads<'a> {
    /// Forces on patches. Default: none.
    pub forces: &'a [DeadLoad],
    /// Patches that are held, at most 64. Default: none.
    pub prescribed: &'a [PrescribedPatch],
    /// Acceleration by gravity, m/s^2. Default: zero.
    pub gravity: [f64; 3],
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
    /// Reaction at each prescribed patch, N: the force of the body on what holds it.
    pub reactions: Vec<[f64; 3]>,
    /// The same reactions by the linear theory, N.
    pub linear_reactions: Vec<[f64; 3]>,
    /// Elastic energy, J.
    pub energy: f64,
    /// Total number of Newton iterations.
    pub rounds: usize,
    /// Remaining |load - inner forces| / |load| with the forces at held patches among the load, at
    /// most 1e-8, or 0 without a load.
    ///
    /// This is the error of the result as a solution on its mesh.
    pub residual: f64,
}

/// Solves for the shape of an anchored body, or of a free one between held patches, at rest under
/// loads.
///
/// What the held patches leave free of a free body's rigid motion, such as the turn about the line
/// through two of them, stays as it is found.
///
/// # Errors
/// Returns the errors of [`bake`](crate::bake()) for the mesh, the material and the anchors.
/// Returns [`BakeError::Parameter`] for a Poisson ratio above 0.45 (the nodal pressure has no
/// nonlinear form here), for a body without anchors that bears other loads than held patches, for
/// held patches that overlap so far that they cannot be told apart, and when no stable shape is
/// found ("load").
pub fn deflect(
    mesh: &TetMesh,
    config: &BakeConfig,
    material: Material,
    loads: &StaticLoads<'_>,
) -> Result<Deflection, BakeError> {
    config.check()?;
    let refuse = |name, expected, got| Err(BakeError::Parameter { name, expected, got });
    if config.poisson > 0.45 {
        return refuse("Poisson ratio", "at most 0.45 for a nonlinear solution", config.poisson);
    }
    let free = config.is_free();
    if free && (loads.prescribed.is_empty() || !loads.forces.is_empty() || loads.gravity != [0.0; 3]) {
        return refuse("anchors", "at least one, or held patches and no other load", 0.0);
    }
    if loads.prescribed.len() > 64 {
        return refuse("held patches", "at most 64", loads.prescribed.len() as f64);
    }
    let numbers = loads.forces.iter().flat_map(|load| load.force);
    let numbers = numbers.chain(loads.prescribed.iter().flat_map(|held| held.displacement));
    if let Some(bad) = numbers.chain(loads.gravity).find(|x| !x.is_finite()) {
        return refuse("load", "finite numbers", bad);
    }
    mesh.check().map_err(BakeError::Mesh)?;
    let mut mesh = mesh.clone();
    mesh.drop_unused_nodes();
    let mut fe = FeMesh::new(&mesh, config.element);
    region::vary(&mut fe, config)?;
    let held = support::anchored_nodes(&fe, config)?;
    let graph = fe.graph(false);
    support::check_connected(&fe, &graph, &held, config)?;
    let (number, ordered) = elimination_order(&fe, &graph, &held);
    let skin = Skin::new(&mesh, &fe, None, &number)?;
    let dofs = 3 * number.iter().filter(|&&row| row != ANCHORED).count();
    let places = |patch: &Patch| {
        let mut places = Vec::new();
        for &(vertex, weight) in patch.entries() {
            skin.spread(vertex, weight, &mut |node, share| places.push((number[node as usize], share)));
        }
        places.retain(|(row, _)| *row != ANCHORED);
        places
    };
    let lame = law(config);
    let mut load = weight(&fe, &number, dofs, loads.gravity.map(|g| g * config.density));
    let spread: Vec<Places> = loads.forces.iter().map(|dead| places(&dead.patch)).collect();
    for (places, dead) in spread.iter().zip(loads.forces) {
        for &(row, share) in places {
            (0..3).for_each(|axis| load[3 * row as usize + axis] += share * dead.force[axis]);
        }
    }
    let pinned: Vec<Places> = loads.prescribed.iter().map(|held| places(&held.patch)).collect();
    let wanted: Vec<f64> = loads.prescribed.iter().flat_map(|held| held.displacement).collect();
    let problem = Problem {
        continuum: Continuum { fe: &fe, law: material.with(lame.lambda, lame.mu), number: &number },
        ordered: &ordered,
        free,
        symbolic: Symbolic::new(&ordered),
        load,
        pinned,
    };
    let by_linear_theory =
        problem.newton(&vec![0.0; dofs], 1.0, &wanted, false)?.ok_or_else(|| no_shape(0.0))?;
    let linear = by_linear_theory.way;

    let mut u = vec![0.0; dofs];
    let (mut done, mut increment, mut rounds, mut residual) = (0.0, 0.25f64, 0, 0.0);
    let mut forces = vec![0.0; wanted.len()];
    let loaded = problem.load.iter().chain(&wanted).any(|x| *x != 0.0);
    while done < 1.0 && loaded {
        let next = (done + increment).min(1.0);
        match problem.solve(&u, next, &wanted, &mut rounds)? {
            Some(solved) => {
                (u, forces, residual) = (solved.u, solved.forces, solved.residual);
                done = next;
                increment *= 1.5;
            }
            None => {
                increment *= 0.5;
                if increment < SMALLEST {
                    return Err(no_shape(done));
                }
            }
        }
    }
    let at_surface = |values: &[f64]| -> Vec<[f64; 3]> {
        (0..skin.mesh.positions().len() as u32)
            .map(|vertex| {
                let mut sum = [0.0; 3];
                skin.spread(vertex, 1.0, &mut |n, share| {
                    let row = number[n as usize];
                    if row != ANCHORED {
                        (0..3).for_each(|k| sum[k] += share * values[3 * row as usize + k]);
                    }
                });
                sum
            })
            .collect()
    };
    let reactions = |forces: &[f64]| forces.as_chunks::<3>().0.iter().map(|f| f.map(|x| -x)).collect();
    Ok(Deflection {
        surface: at_surface(&u),
        linear: at_surface(&linear),
        patches: spread.iter().map(|places| mean(places, &u)).collect(),
        reactions: reactions(&forces),
        linear_reactions: reactions(&by_linear_theory.forces),
        energy: problem.continuum.elastic_energy(&u),
        rounds,
        residual,
    })
}

fn no_shape(done: f64) -> BakeError {
    BakeError::Parameter { name: "load", expected: "one under which the body has a stable shape", got: done }
}

/// Rows of free nodes with their shares.
type Places = Vec<(u32, f64)>;

/// Returns the mean of the nodal values at these places.
fn mean(places: &[(u32, f64)], values: &[f64]) -> [f64; 3] {
    places.iter().fold([0.0; 3], |sum, &(row, share)| {
        std::array::from_fn(|k| sum[k] + share * values[3 * row as usize + k])
    })
}

/// Returns the nodal forces of a force per volume of the body's base density, N/m^3.
fn weight(fe: &FeMesh, number: &[u32], dofs: usize, per_volume: [f64; 3]) -> Vec<f64> {
    let mut out = vec![0.0; dofs];
    for (index, nodes) in fe.elements().enumerate() {
        for (i, &node) in nodes.iter().enumerate() {
            // Integrals of the shape functions over the element, as shares of its volume.
            let share = match fe.element {
                Element::Tet4 => 0.25,
                Element::Tet10 if i < 4 => -0.05,
                Element::Tet10 => 0.2,
            };
            let row = number[node as usize];
            if row != ANCHORED {
                (0..3).for_each(|k| {
                    out[3 * row as usize + k] += share * fe.filled_volume(index) * per_volume[k]
                });
            }
        }
    }
    out
}

fn norm(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// One step of Newton's method.
struct NewtonStep {
    way: Vec<f64>,
    /// Forces on the body at the held patches at the end of the whole way, N.
    forces: Vec<f64>,
}

/// An equilibrium under a part of the load.
struct Equilibrium {
    u: Vec<f64>,
    forces: Vec<f64>,
    residual: f64,
}

struct Problem<'a> {
    continuum: Continuum<'a>,
    ordered: &'a crate::fem::Lists,
    /// Whether the body has no anchors.
    free: bool,
    symbolic: Symbolic,
    load: Vec<f64>,
    pinned: Vec<Places>,
}

impl Problem<'_> {
    /// Finds the equilibrium under a share `part` of all loads, from the one at `start`. Returns
    /// `None` if the iteration does not converge.
    fn solve(
        &self,
        start: &[f64],
        part: f64,
        wanted: &[f64],
        rounds: &mut usize,
    ) -> Result<Option<Equilibrium>, BakeError> {
        let wanted: Vec<f64> = wanted.iter().map(|x| part * x).collect();
        let mut u = start.to_vec();
        // Without held patches, all shapes are allowed from the start.
        let mut allowed = self.pinned.is_empty();
        // Newton's own tangent converges fastest, but costs a factorization where it is indefinite.
        let (mut project, mut attempts) = (false, 3);
        for _ in 0..ROUNDS {
            *rounds += 1;
            let Some(NewtonStep { way, forces }) = self.newton(&u, part, &wanted, project)? else {
                if project {
                    return Ok(None);
                }
                (project, attempts) = (true, attempts - 1);
                continue;
            };
            let at = |share: f64| u.iter().zip(&way).map(|(u, du)| u + share * du).collect::<Vec<f64>>();
            let mut trial = at(1.0);
            if allowed {
                let before = self.potential(&u, part);
                let room = 1e-12 * (before.abs() + self.continuum.elastic_energy(&u));
                let mut share = 1.0;
                let mut halvings = 0;
                let worse = |potential: f64| potential.is_nan() || potential > before + room;
                while worse(self.potential(&trial, part)) {
                    halvings += 1;
                    if halvings > HALVINGS {
                        break;
                    }
                    share *= 0.5;
                    trial = at(share);
                }
                if halvings > HALVINGS {
                    if project {
                        return Ok(None);
                    }
                    project = true;
                    continue;
                }
            }
            // The whole first way leads to where the patches are held. Later ways stay there.
            (allowed, project) = (true, attempts == 0);
            u = trial;
            let (left, size) = self.residual(&u, part, &forces);
            if !left.is_finite() {
                return Ok(None);
            }
            if left <= TOLERANCE * size {
                let residual = if size > 0.0 { left / size } else { 0.0 };
                return Ok(Some(Equilibrium { u, forces, residual }));
            }
        }
        Ok(None)
    }

    /// Returns the size of the force that is out of balance, and that of the load.
    fn residual(&self, u: &[f64], part: f64, forces: &[f64]) -> (f64, f64) {
        let mut out: Vec<f64> = self.load.iter().map(|f| part * f).collect();
        for (places, force) in self.pinned.iter().zip(forces.as_chunks::<3>().0) {
            for &(row, share) in places {
                (0..3).for_each(|axis| out[3 * row as usize + axis] += share * force[axis]);
            }
        }
        let size = norm(&out);
        let inner = self.continuum.inner_forces(u);
        out.iter_mut().zip(&inner).for_each(|(out, inner)| *out -= inner);
        (norm(&out), size)
    }

    /// Returns the way of Newton's method at `u` to where the patches are `wanted`. `None`: the
    /// tangent is not positive definite.
    fn newton(
        &self,
        u: &[f64],
        part: f64,
        wanted: &[f64],
        project: bool,
    ) -> Result<Option<NewtonStep>, BakeError> {
        let (matrix, inner) = self.tangent(u, project);
        let Ok(factor) = Factor::new(self.symbolic.clone(), &matrix, &[]) else { return Ok(None) };
        drop(matrix);
        let mut way: Vec<f64> = self.load.iter().zip(&inner).map(|(f, i)| part * f - i).collect();
        factor.solve(&mut way, 1);
        let rows = wanted.len();
        if rows == 0 {
            return Ok(Some(NewtonStep { way, forces: Vec::new() }));
        }
        // The answers to unit forces on the patches, row by row.
        let mut answers = vec![0.0; u.len() * rows];
        for (index, places) in self.pinned.iter().enumerate() {
            for &(row, share) in places {
                for axis in 0..3 {
                    answers[(3 * row as usize + axis) * rows + 3 * index + axis] += share;
                }
            }
        }
        factor.solve(&mut answers, rows);
        let overlap = BakeError::Parameter {
            name: "held patches",
            expected: "patches that can be moved one by one",
            got: self.pinned.len() as f64,
        };
        let mut schur = DMatrix::zeros(rows, rows);
        let mut missing = DVector::zeros(rows);
        for (index, places) in self.pinned.iter().enumerate() {
            for axis in 0..3 {
                let i = 3 * index + axis;
                missing[i] = wanted[i];
                for &(row, share) in places {
                    let dof = 3 * row as usize + axis;
                    missing[i] -= share * (u[dof] + way[dof]);
                    for j in 0..rows {
                        schur[(i, j)] += share * answers[dof * rows + j];
                    }
                }
            }
        }
        let forces = nalgebra::Cholesky::new(schur).ok_or(overlap)?.solve(&missing);
        for (way, answers) in way.iter_mut().zip(answers.chunks_exact(rows)) {
            *way += answers.iter().zip(&forces).map(|(a, f)| a * f).sum::<f64>();
        }
        Ok(Some(NewtonStep { way, forces: forces.as_slice().to_vec() }))
    }

    /// Returns the elastic energy minus the work of a share `part` of the loads, J.
    fn potential(&self, u: &[f64], part: f64) -> f64 {
        self.continuum.elastic_energy(u) - part * self.load.iter().zip(u).map(|(f, u)| f * u).sum::<f64>()
    }

    /// Returns the tangent stiffness, with `project` the positive semidefinite one, and the inner
    /// forces at a displacement.
    fn tangent(&self, u: &[f64], project: bool) -> (BlockCsr, Vec<f64>) {
        const BATCH: usize = 512;
        let per = self.continuum.fe.element.node_count();
        let mut out = BlockCsr::zeros(self.ordered);
        let mut batch = vec![[0.0; MAX_NODES * MAX_NODES * 9]; BATCH];
        let count = self.continuum.fe.affine.len();
        for first in (0..count).step_by(BATCH) {
            let size = BATCH.min(count - first);
            batch[..size]
                .par_iter_mut()
                .enumerate()
                .for_each(|(local, k)| self.continuum.element_tangent(first + local, u, project, k));
            for (local, k) in batch[..size].iter().enumerate() {
                let nodes = &self.continuum.fe.connectivity[(first + local) * per..][..per];
                for (i, &a) in nodes.iter().enumerate() {
                    let row = self.continuum.number[a as usize];
                    if row == ANCHORED {
                        continue;
                    }
                    for (j, &b) in nodes.iter().enumerate() {
                        let column = self.continuum.number[b as usize];
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
        if self.free {
            // The tangent of a free body has no inverse. This only changes the way of the rounds:
            // it has no part in the forces that balance at the end.
            for row in 0..out.nodes() as u32 {
                let at = out.position(row, row);
                (0..3).for_each(|axis| out.stiffness[9 * at + 4 * axis] *= 1.0 + LOOSE);
            }
        }
        (out, self.continuum.inner_forces(u))
    }
}

#[cfg(test)]
#[path = "nonlinear_tests.rs"]
mod tests;

//! Residual flexibility of patches: what the kept modes leave out of the static compliance at a hand.

use faer::Mat;
use nalgebra::Matrix3;
use pliant_modal::{FlexibilitySite, ModelError, Patch, SurfaceMesh};
use rayon::prelude::*;

use crate::blocks::{self, Tall};
use crate::fem::ANCHORED;
use crate::lanczos::Modes;
use crate::solver::Solver;
use crate::surface::Skin;

/// Patches per group of right-hand sides; three columns each.
const GROUP: usize = 8;

/// Multiplications that the sites may take unless their number is given: about a second of one core.
const BUDGET: f64 = 1.4e10;

/// Groups that are solved side by side.
const WAVE: usize = 8;

/// `W^T (K^-1 - Phi Lambda^-1 Phi^T) W` for patches of each radius (m) around each vertex.
pub(crate) fn sites(
    solver: &Solver,
    modes: &Modes,
    skin: &Skin,
    number: &[u32],
    vertices: &[u32],
    radii: &[f64],
    report: &mut dyn FnMut(f64),
) -> Result<Vec<FlexibilitySite>, ModelError> {
    let mut patches = Vec::with_capacity(vertices.len() * radii.len());
    for &vertex in vertices {
        for &radius in radii {
            patches.push(Patch::around(&skin.mesh, vertex, radius)?);
        }
    }
    let held = Held::new(solver);
    // Patches that are eliminated close together share a group: its loads rest on few branches of the factor.
    let mut order: Vec<usize> = (0..patches.len()).collect();
    order.sort_by_key(|&index| skin.first_row(patches[index].center(), number));
    let mut out: Vec<Option<FlexibilitySite>> = vec![None; patches.len()];
    for (index, wave) in order.chunks(GROUP * WAVE).enumerate() {
        report((index * GROUP * WAVE) as f64 / patches.len() as f64);
        let found: Vec<Vec<[[f64; 3]; 3]>> = wave
            .par_chunks(GROUP)
            .map(|group| {
                let loads: Vec<Load> =
                    group.iter().map(|&site| Load::new(&patches[site], skin, number)).collect();
                held.residual(solver, modes, &loads)
            })
            .collect();
        for (&site, flexibility) in wave.iter().zip(found.into_iter().flatten()) {
            let (vertex, radius) = (patches[site].center(), patches[site].radius());
            out[site] = Some(FlexibilitySite { vertex, radius, flexibility });
        }
    }
    Ok(out.into_iter().flatten().collect())
}

/// How many places on the surface cost about [`BUDGET`]: each patch goes once through the factor with three columns.
pub(crate) fn affordable_sites(solver: &Solver, radii: usize) -> usize {
    let patch = 3.0 * solver.factor.symbolic.values as f64;
    ((BUDGET / (patch * radii.max(1) as f64)) as usize).clamp(64, 512)
}

/// A unit force on a patch, the same along each axis: rows of nodes and their shares.
struct Load(Vec<(usize, f64)>);

impl Load {
    fn new(patch: &Patch, skin: &Skin, number: &[u32]) -> Self {
        let mut rows = Vec::new();
        for &(vertex, weight) in patch.entries() {
            skin.spread(vertex, weight, &mut |node, share| {
                let row = number[node as usize];
                if row != ANCHORED {
                    rows.push((row as usize, share));
                }
            });
        }
        Self(rows)
    }

    /// `X^T W` for a block X of `width` columns: `[column][axis]`.
    fn project(&self, x: &[f64], width: usize) -> Vec<[f64; 3]> {
        let mut out = vec![[0.0; 3]; width];
        for &(row, share) in &self.0 {
            for (axis, x) in x[3 * row * width..][..3 * width].chunks_exact(width).enumerate() {
                for (out, x) in out.iter_mut().zip(x) {
                    out[axis] += share * x;
                }
            }
        }
        out
    }
}

/// What the pseudo-inverse of a free body adds to the factor: `Z = (K + springs)^-1 M R` and `R^T M Z`.
struct Held {
    free: Option<(Vec<f64>, Mat<f64>)>,
}

impl Held {
    fn new(solver: &Solver) -> Self {
        let free = solver.rigid.as_ref().map(|rigid| {
            let mut z = rigid.mass_times_modes.clone();
            solver.factor.solve(&mut z, 6);
            let inner = blocks::gram(Tall::new(&rigid.mass_times_modes, 6), Tall::new(&z, 6));
            (z, inner)
        });
        Self { free }
    }

    /// The residual flexibility of each load.
    ///
    /// `W^T K^-1 W = |L^-1 W|^2`: half a solution is enough. For a free body, with `r = R^T W`:
    /// `W^T K^+ W = |L^-1 W|^2 - (W^T Z) r - r^T (Z^T W) + r^T (R^T M Z) r`.
    fn residual(&self, solver: &Solver, modes: &Modes, loads: &[Load]) -> Vec<[[f64; 3]; 3]> {
        let width = 3 * loads.len();
        let mut x = vec![0.0; solver.dofs() * width];
        for (place, load) in loads.iter().enumerate() {
            for &(row, share) in &load.0 {
                for axis in 0..3 {
                    x[(3 * row + axis) * width + 3 * place + axis] += share;
                }
            }
        }
        solver.factor.forward(&mut x, width);
        let half = blocks::gram(Tall::new(&x, width), Tall::new(&x, width));
        let one = |(place, load): (usize, &Load)| {
            let along = load.project(&modes.phi, modes.lambda.len());
            let free = self
                .free
                .as_ref()
                .zip(solver.rigid.as_ref())
                .map(|((z, inner), rigid)| (load.project(&rigid.modes, 6), load.project(z, 6), inner));
            let entry = |i: usize, j: usize| {
                let mut sum = half[(3 * place + i, 3 * place + j)];
                if let Some((r, b, inner)) = &free {
                    for k in 0..6 {
                        sum -= b[k][i] * r[k][j] + r[k][i] * b[k][j];
                        for l in 0..6 {
                            sum += r[k][i] * inner[(k, l)] * r[l][j];
                        }
                    }
                }
                let modal: f64 =
                    along.iter().zip(&modes.lambda).map(|(phi, lambda)| phi[i] * phi[j] / lambda).sum();
                sum - modal
            };
            settle(&Matrix3::from_fn(|i, j| 0.5 * (entry(i, j) + entry(j, i))))
        };
        loads.iter().enumerate().map(one).collect()
    }
}

/// Rounding must not make a compliance negative: where the kept modes say nearly all, what they leave may come out so.
/// The nearest positive semi-definite matrix then has the negative eigenvalues set to zero.
fn settle(residual: &Matrix3<f64>) -> [[f64; 3]; 3] {
    let eigen = residual.symmetric_eigen();
    let nearest = if eigen.eigenvalues.min() < 0.0 {
        let kept = Matrix3::from_diagonal(&eigen.eigenvalues.map(|value| value.max(0.0)));
        let turned = eigen.eigenvectors * kept * eigen.eigenvectors.transpose();
        0.5 * (turned + turned.transpose())
    } else {
        *residual
    };
    std::array::from_fn(|i| std::array::from_fn(|j| nearest[(i, j)]))
}

/// Vertices spread over the surface: each next one is the furthest from those before. Anchored vertices are left out.
pub(crate) fn spread_vertices(surface: &SurfaceMesh, count: usize) -> Vec<u32> {
    let positions = surface.positions();
    let candidates: Vec<u32> =
        (0..positions.len() as u32).filter(|&v| !surface.anchored()[v as usize]).collect();
    let distance2 = |v: u32, q: [f64; 3]| -> f64 {
        (0..3).map(|k| (f64::from(positions[v as usize][k]) - q[k]).powi(2)).sum()
    };
    let n = candidates.len().max(1) as f64;
    let mean =
        [0, 1, 2].map(|k| candidates.iter().map(|&v| f64::from(positions[v as usize][k])).sum::<f64>() / n);
    // The first is the furthest from the middle; ties go to the lower number.
    let mut nearest: Vec<f64> = candidates.iter().map(|&v| distance2(v, mean)).collect();
    let mut out = Vec::with_capacity(count.min(candidates.len()));
    while out.len() < count.min(candidates.len()) {
        let mut best = 0;
        for (index, &d) in nearest.iter().enumerate() {
            if d > nearest[best] {
                best = index;
            }
        }
        if nearest[best] <= 0.0 {
            break;
        }
        let chosen = candidates[best];
        let at = positions[chosen as usize].map(f64::from);
        let first = out.is_empty();
        for (&v, d) in candidates.iter().zip(&mut nearest) {
            let now = distance2(v, at);
            *d = if first { now } else { d.min(now) };
        }
        out.push(chosen);
    }
    out
}

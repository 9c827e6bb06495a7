//! Residual flexibility of patches: what the kept modes leave out of the static compliance at a hand.

use faer::Mat;
use pliant_modal::{FlexibilitySite, ModelError, Patch, SurfaceMesh};

use crate::blocks::{self, Tall};
use crate::fem::ANCHORED;
use crate::lanczos::Modes;
use crate::solver::Solver;
use crate::surface::Skin;

/// Patches per group of right-hand sides; three columns each.
const GROUP: usize = 8;

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
    for (index, group) in order.chunks(GROUP).enumerate() {
        report((index * GROUP) as f64 / patches.len() as f64);
        let width = 3 * group.len();
        let mut loads = vec![0.0; solver.dofs() * width];
        for (place, &patch) in group.iter().enumerate() {
            let patch = &patches[patch];
            for &(vertex, weight) in patch.entries() {
                skin.spread(vertex, weight, &mut |node, weight| {
                    let row = number[node as usize];
                    if row != ANCHORED {
                        for axis in 0..3 {
                            loads[(3 * row as usize + axis) * width + 3 * place + axis] += weight;
                        }
                    }
                });
            }
        }
        let full = held.compliance(solver, &mut loads, width, modes);
        for (place, &site) in group.iter().enumerate() {
            let patch = &patches[site];
            let flexibility = std::array::from_fn(|i| {
                std::array::from_fn(|j| {
                    let entry = |i: usize, j: usize| full[(3 * place + i, j)];
                    let residual = 0.5 * (entry(i, j) + entry(j, i));
                    // Rounding must not make a compliance negative.
                    if i == j { residual.max(0.0) } else { residual }
                })
            });
            out[site] = Some(FlexibilitySite { vertex: patch.center(), radius: patch.radius(), flexibility });
        }
    }
    Ok(out.into_iter().flatten().collect())
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

    /// The 3x3 residual compliances of the loads W (three columns a patch), stacked: row `3 place + i`.
    ///
    /// `W^T K^-1 W = |L^-1 W|^2`: half a solution is enough. For a free body, with `r = R^T W`:
    /// `W^T K^+ W = |L^-1 W|^2 - (W^T Z) r - r^T (Z^T W) + r^T (R^T M Z) r`.
    fn compliance(&self, solver: &Solver, loads: &mut [f64], width: usize, modes: &Modes) -> Mat<f64> {
        let count = modes.lambda.len();
        let along = blocks::gram(Tall::new(&modes.phi, count), Tall::new(loads, width));
        let free = self.free.as_ref().zip(solver.rigid.as_ref()).map(|((z, inner), rigid)| {
            let r = blocks::gram(Tall::new(&rigid.modes, 6), Tall::new(loads, width));
            let b = blocks::gram(Tall::new(z, 6), Tall::new(loads, width));
            (r, b, inner)
        });
        solver.factor.forward(loads, width);
        let half = blocks::gram(Tall::new(loads, width), Tall::new(loads, width));
        Mat::from_fn(width, 3, |row, j| {
            let (i, j) = (row, row - row % 3 + j);
            let mut sum = half[(i, j)];
            if let Some((r, b, inner)) = &free {
                for k in 0..6 {
                    sum -= b[(k, i)] * r[(k, j)] + r[(k, i)] * b[(k, j)];
                    for l in 0..6 {
                        sum += r[(k, i)] * inner[(k, l)] * r[(l, j)];
                    }
                }
            }
            for mode in 0..count {
                sum -= along[(mode, i)] * along[(mode, j)] / modes.lambda[mode];
            }
            sum
        })
    }
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

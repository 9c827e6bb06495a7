//! Residual flexibility of patches: the part of the static compliance under a hand that the kept
//! modes leave out.

use faer::Mat;
use nalgebra::Matrix3;
use pliant_modal::{FlexibilitySite, ModelError, Patch, SurfaceMesh};
use rayon::prelude::*;

use crate::blocks::{self, Tall};
use crate::compliance::{Load, Plan, Six};
use crate::fem::ANCHORED;
use crate::lanczos::Eigenpairs;
use crate::solver::Solver;
use crate::surface::Skin;

/// Limit on the multiplications for the sites when their number is not given. This takes one to two
/// seconds on two cores.
const BUDGET: f64 = 1.3e11;

/// Limit on the numbers in the right-hand sides of one front: half a gigabyte in double precision,
/// a quarter in single precision.
const MEMORY: usize = 64 << 20;

/// Number of multiplications above which single precision is used, with a relative error of about
/// 1e-6 in the compliance.
const FAST: f64 = 1e10;

/// Rules that thin out wide patches when the work is large and when it is very large.
///
/// Wide patches are the costly ones and hardly change from one vertex to the next, so they are
/// baked around some vertices only. Each rule holds a number of multiplications and pairs of a
/// radius, as a fraction of the body's size, and a stride: from that radius on, one vertex in so
/// many is used.
const THIN: [(f64, [(f64, usize); 2]); 2] =
    [(FAST, [(0.1, 4), (f64::MAX, 1)]), (6.0 * FAST, [(0.1, 8), (0.05, 2)])];

/// Minimum and maximum number of sites when not all vertices can be baked.
const SPREAD: [usize; 2] = [64, 512];

/// Number of patches per group when each patch has its own three right-hand side columns.
const GROUP: usize = 8;

/// Number of groups that are solved in parallel.
const WAVE: usize = 8;

/// Returns `W^T (K^-1 - Phi Lambda^-1 Phi^T) W` for patches of each radius (m) around `count`
/// evenly spread surface vertices.
///
/// Without `count`, all vertices are used if [`BUDGET`] and [`MEMORY`] allow.
pub(crate) fn sites(
    solver: &Solver,
    modes: &Eigenpairs,
    skin: &Skin,
    number: &[u32],
    count: Option<usize>,
    radii: &[f64],
    report: &mut dyn FnMut(f64),
) -> Result<Vec<FlexibilitySite>, ModelError> {
    let free = (0..skin.mesh.positions().len() as u32).filter(|&v| !skin.mesh.anchored()[v as usize]);
    let mut vertices: Vec<u32> = free.collect();
    if let Some(count) = count.filter(|&count| count < vertices.len()) {
        vertices = spread_vertices(&skin.mesh, vertices, count);
    }
    let (mut patches, mut loads) = patches(skin, number, &mut vertices, radii, &|_, _| true)?;
    let mut plan = Plan::new(&solver.factor, &loads);
    if count.is_none()
        && let Some((_, thin)) = THIN.iter().rev().find(|(cost, _)| plan.cost() > *cost)
    {
        // Each vertex is the furthest from those before it, so any leading part of the order is
        // spread evenly.
        let mut rank = vec![usize::MAX; skin.mesh.positions().len()];
        let order = spread_vertices(&skin.mesh, vertices.clone(), vertices.len().div_ceil(2));
        order.into_iter().enumerate().for_each(|(index, v)| rank[v as usize] = index);
        let (size, all) = (skin.mesh.size(), vertices.len());
        let wanted = |v: u32, radius: f64| {
            let rule = thin.iter().find(|(from, _)| radius >= from * size);
            rule.is_none_or(|(_, one_in)| rank[v as usize] < all.div_ceil(*one_in))
        };
        (patches, loads) = self::patches(skin, number, &mut vertices, radii, &wanted)?;
        plan = Plan::new(&solver.factor, &loads);
    }
    let apart = 3.0 * solver.factor.symbolic.values as f64;
    if count.is_none() && (plan.cost() > BUDGET || plan.largest_block() > MEMORY) {
        // With shared node columns, few sites cost as much as many, because their patches touch
        // nearly all nodes. The number of sites is therefore limited to what separate solves can
        // afford.
        let affordable = (0.1 * BUDGET / (apart * radii.len().max(1) as f64)) as usize;
        vertices = spread_vertices(&skin.mesh, vertices, affordable.clamp(SPREAD[0], SPREAD[1]));
        (patches, loads) = self::patches(skin, number, &mut vertices, radii, &|_, _| true)?;
        plan = Plan::new(&solver.factor, &loads);
    }
    let together = plan.cost() < apart * loads.len() as f64 && plan.largest_block() <= MEMORY;
    let whole = if together {
        // A free body needs double precision. On its springs the rigid motion is far larger than
        // the deformation, and the removal of this motion cancels digits.
        plan.compliances(solver.rigid.is_none() && plan.cost() > FAST, report)
    } else {
        one_by_one(solver, &loads, report)
    };
    let held = HeldVertices::new(solver);
    let finish = |((patch, load), whole): ((&Patch, &Load), &Six)| FlexibilitySite {
        vertex: patch.center(),
        radius: patch.radius(),
        flexibility: held.residual(solver, modes, load, whole),
    };
    Ok(patches.par_iter().zip(&loads).zip(&whole).map(finish).collect())
}

/// Returns the mean displacement of `count` patches that are spread over the surface, by mode.
pub(crate) fn spread_patches(
    skin: &Skin,
    number: &[u32],
    modes: &Eigenpairs,
    count: usize,
    radius: f64,
) -> Result<Vec<[Vec<f64>; 3]>, ModelError> {
    let free = (0..skin.mesh.positions().len() as u32).filter(|&v| !skin.mesh.anchored()[v as usize]);
    let vertices = spread_vertices(&skin.mesh, free.collect(), count);
    let width = modes.lambda.len();
    let rows = |v: &u32| {
        let patch = Patch::around(&skin.mesh, *v, radius)?;
        let along = project(&load(&patch, skin, number), &modes.phi, width);
        Ok(std::array::from_fn(|axis| along.iter().map(|x| x[axis]).collect()))
    };
    vertices.iter().map(rows).collect()
}

/// Returns the patches of each radius around `vertices` and their loads.
///
/// Sorts the vertices by elimination order, so that neighbors in the list touch the same nodes.
fn patches(
    skin: &Skin,
    number: &[u32],
    vertices: &mut [u32],
    radii: &[f64],
    wanted: &(dyn Fn(u32, f64) -> bool + Sync),
) -> Result<(Vec<Patch>, Vec<Load>), ModelError> {
    vertices.sort_by_key(|&v| (skin.first_row(v, number), v));
    let patches: Result<Vec<Patch>, ModelError> = vertices
        .par_iter()
        .flat_map_iter(|&v| {
            radii.iter().filter(move |&&r| wanted(v, r)).map(move |&r| Patch::around(&skin.mesh, v, r))
        })
        .collect();
    let patches = patches?;
    let loads = patches.par_iter().map(|patch| load(patch, skin, number)).collect();
    Ok((patches, loads))
}

/// Returns `W^T A^-1 W = |L^-1 W|^2` with three columns for each load.
fn one_by_one(solver: &Solver, loads: &[Load], report: &mut dyn FnMut(f64)) -> Vec<Six> {
    let group = |loads: &[Load]| -> Vec<Six> {
        let width = 3 * loads.len();
        let mut x = vec![0.0; solver.dofs() * width];
        for (place, load) in loads.iter().enumerate() {
            for &(row, share) in load {
                for axis in 0..3 {
                    x[(3 * row + axis) * width + 3 * place + axis] += share;
                }
            }
        }
        solver.factor.forward(&mut x, width);
        let half = blocks::gram(Tall::new(&x, width), Tall::new(&x, width));
        let six = |place: usize| {
            let at = |i, j| half[(3 * place + i, 3 * place + j)];
            [at(0, 0), at(0, 1), at(0, 2), at(1, 1), at(1, 2), at(2, 2)]
        };
        (0..loads.len()).map(six).collect()
    };
    let mut out = Vec::with_capacity(loads.len());
    for wave in loads.chunks(GROUP * WAVE) {
        report(out.len() as f64 / loads.len() as f64);
        let found: Vec<Vec<Six>> = wave.par_chunks(GROUP).map(group).collect();
        out.extend(found.into_iter().flatten());
    }
    out
}

fn load(patch: &Patch, skin: &Skin, number: &[u32]) -> Load {
    let mut rows: Load = Vec::new();
    for &(vertex, weight) in patch.entries() {
        skin.spread(vertex, weight, &mut |node, share| {
            let row = number[node as usize];
            if row != ANCHORED {
                rows.push((row as usize, share));
            }
        });
    }
    rows.sort_unstable_by_key(|&(row, _)| row);
    // Skin vertices in the same element share its nodes, so their shares are added.
    rows.dedup_by(|from, to| {
        let same = from.0 == to.0;
        if same {
            to.1 += from.1;
        }
        same
    });
    rows
}

/// Returns `X^T W` for a block X of `width` columns as `[column][axis]`.
fn project(load: &Load, x: &[f64], width: usize) -> Vec<[f64; 3]> {
    let mut out = vec![[0.0; 3]; width];
    for &(row, share) in load {
        for (axis, x) in x[3 * row * width..][..3 * width].chunks_exact(width).enumerate() {
            for (out, x) in out.iter_mut().zip(x) {
                out[axis] += share * x;
            }
        }
    }
    out
}

/// Terms that the pseudo-inverse of a free body adds to the factor: `Z = (K + springs)^-1 M R` and
/// `R^T M Z`.
struct HeldVertices {
    free: Option<(Vec<f64>, Mat<f64>)>,
}

impl HeldVertices {
    fn new(solver: &Solver) -> Self {
        let free = solver.rigid.as_ref().map(|rigid| {
            let mut z = rigid.mass_times_modes.clone();
            solver.factor.solve(&mut z, 6);
            let inner = blocks::gram(Tall::new(&rigid.mass_times_modes, 6), Tall::new(&z, 6));
            (z, inner)
        });
        Self { free }
    }

    /// Returns the residual flexibility of a load whose `W^T A^-1 W` is `whole`, where `A` is the
    /// factored matrix.
    ///
    /// For a free body, with `r = R^T W`, the compliance is
    /// `W^T K^+ W = W^T A^-1 W - (W^T Z) r - r^T (Z^T W) + r^T (R^T M Z) r`.
    fn residual(&self, solver: &Solver, modes: &Eigenpairs, load: &Load, whole: &Six) -> [[f64; 3]; 3] {
        let along = project(load, &modes.phi, modes.lambda.len());
        let free = self
            .free
            .as_ref()
            .zip(solver.rigid.as_ref())
            .map(|((z, inner), rigid)| (project(load, &rigid.modes, 6), project(load, z, 6), inner));
        let [xx, xy, xz, yy, yz, zz] = *whole;
        let whole = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        let entry = |i: usize, j: usize| {
            let mut sum = whole[i][j];
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
        nearest_semidefinite(&Matrix3::from_fn(|i, j| 0.5 * (entry(i, j) + entry(j, i))))
    }
}

/// Makes a residual positive semi-definite.
///
/// Where the kept modes contain nearly all of the compliance, rounding can make the residual
/// negative. The nearest positive semi-definite matrix has the negative eigenvalues set to zero.
fn nearest_semidefinite(residual: &Matrix3<f64>) -> [[f64; 3]; 3] {
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

/// Selects `count` candidates spread over the surface. Each selected vertex is the furthest from
/// those before it.
fn spread_vertices(surface: &SurfaceMesh, candidates: Vec<u32>, count: usize) -> Vec<u32> {
    let positions = surface.positions();
    let distance2 = |v: u32, q: [f64; 3]| -> f64 {
        (0..3).map(|k| (f64::from(positions[v as usize][k]) - q[k]).powi(2)).sum()
    };
    let n = candidates.len().max(1) as f64;
    let mean =
        [0, 1, 2].map(|k| candidates.iter().map(|&v| f64::from(positions[v as usize][k])).sum::<f64>() / n);
    // The first vertex is the furthest from the center. Among equal distances the lower index wins.
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

#[cfg(test)]
mod tests {
    use pliant_mesh::shapes;

    use super::*;
    use crate::bake::{elimination_order, law};
    use crate::fem::FeMesh;
    use crate::symbolic::Symbolic;
    use crate::{BakeConfig, support};
    use pliant_modal::Element;

    /// Node columns, patch columns and single precision give the same compliances within their
    /// tolerances, also on a skin whose vertices depend on several nodes.
    #[test]
    fn every_way_gives_the_same_compliances() {
        let mesh = shapes::bar([8, 4, 4], [1.0, 0.4, 0.4]).unwrap();
        let config = BakeConfig { anchors: vec!["x<0.001".parse().unwrap()], ..BakeConfig::linear() };
        let fe = FeMesh::new(&mesh, Element::Tet10);
        let graph = fe.graph(false);
        let held = support::anchored_nodes(&fe, &config).unwrap();
        let (number, ordered) = elimination_order(&fe, &graph, &held);
        let matrix = fe.assemble(&law(&config), &number, &ordered);
        let solver = Solver::new(&matrix, Symbolic::new(&ordered), None).unwrap();
        let mut worn = shapes::bar([5, 3, 3], [0.98, 0.38, 0.38]).unwrap().boundary().0;
        worn.positions.iter_mut().flatten().for_each(|x| *x += 0.01);
        for skin in [None, Some(&worn)] {
            let skin = Skin::new(&mesh, &fe, skin, &number).unwrap();
            let mut vertices: Vec<u32> = (0..skin.mesh.positions().len() as u32).collect();
            let (_, loads) =
                patches(&skin, &number, &mut vertices, &[0.05, 0.15, 0.4], &|_, _| true).unwrap();
            let plan = Plan::new(&solver.factor, &loads);
            let (exact, fast) = (plan.compliances(false, &mut |_| ()), plan.compliances(true, &mut |_| ()));
            let apart = one_by_one(&solver, &loads, &mut |_| ());
            for ((load, exact), (fast, apart)) in loads.iter().zip(&exact).zip(fast.iter().zip(&apart)) {
                let size = exact[0] + exact[3] + exact[5];
                assert_eq!(size > 0.0, !load.is_empty());
                for k in 0..6 {
                    assert!((exact[k] - apart[k]).abs() <= 1e-12 * size, "{exact:?} and {apart:?}");
                    assert!((exact[k] - fast[k]).abs() <= 2e-6 * size, "{exact:?} and {fast:?}");
                }
            }
        }
    }
}

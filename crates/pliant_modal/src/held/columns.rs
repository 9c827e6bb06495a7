//! Columns of held patches: displacements of a region in which the coordinates have no part.

use nalgebra::{DMatrix, Vector3};

use super::{
    HeldShapes,
    region::{NodeLoad, Region},
    thinned,
};
use crate::{
    ElasticEnergy, Hyperelastic, ModalModel, ReducedElasticity,
    cubature::{self, GuidedShape, Point, Rows},
};

/// Combinations of columns with less than this share of the largest energy are rounding errors.
const LEAST: f64 = 1e-6;

/// Combinations of columns of which the coordinates have all but this share of the energy end.
const NEW: f64 = 1e-3;

/// Corrections whose energy is a smaller share than this of that of the shapes end.
const CORRECTION: f64 = 1e-8;

/// Number of Newton rounds that find a shape anew with more columns.
const REFINEMENTS: usize = 2;

/// Shares of the displacements of hands at which shapes are found.
const SHARES: [f64; 4] = [0.35, 0.7, 1.0, 1.25];

/// How far beside the end of its path a hand is in further shapes, as a share of the longest path
/// and at least as a share of the body's size.
const BESIDE: [f64; 2] = [0.25, 0.04];

/// Largest energy density of a shape beside, as a share of Young's modulus.
const ENERGY: f64 = 0.02;

/// How shapes on the paths of hands are corrected, and what is kept of them.
pub(super) struct Effort {
    /// Maximum number of times that shapes are corrected.
    corrections: usize,
    /// Share of its energy by which the shape at the ends of the paths is corrected at which
    /// corrections end.
    enough: f64,
    /// By how much more the correction of that shape counts than those of the others. The stiffness
    /// is that in it, so that its corrections are the right ones, while those of others can be far
    /// off.
    end: f64,
    /// Number of columns that are kept beside the static ones.
    kept: usize,
    /// Largest number of points of the rule, by coordinate.
    pub(super) points: usize,
    /// Largest number of points inside the region from which they are chosen.
    pub(super) candidates: usize,
}

impl Effort {
    /// The effort for hands that have led their patches by `displacements` (m).
    pub(super) fn of(displacements: &[Vector3<f64>], region: &Region<'_>) -> &'static Self {
        let is_at_rest = displacements.iter().all(|displacement| *displacement == Vector3::zeros());
        if displacements.len() == 2 && !is_at_rest && !region.is_anchored() {
            return &TWO_ON_A_FREE_BODY;
        }
        let efforts = if is_at_rest { &AT_REST } else { &EFFORTS };
        &efforts[displacements.len().clamp(1, efforts.len()) - 1]
    }
}

/// By the number of patches. Two hands that shear a bunny converge slowly and need more columns:
/// they were off by 15 % with a share of 5e-4, and by 9 % with three points by coordinate. With
/// thirty columns for four hands that twist a bar, the rule follows what the shapes do by chance.
const EFFORTS: [Effort; HeldShapes::MAX_PATCHES] = [
    Effort { corrections: 6, enough: 5e-4, end: 1.0, kept: 6, points: 3, candidates: 16_000 },
    Effort { corrections: 8, enough: 1e-5, end: 3.0, kept: 14, points: 4, candidates: 16_000 },
    Effort { corrections: 6, enough: 5e-4, end: 1.0, kept: 10, points: 3, candidates: 16_000 },
    Effort { corrections: 6, enough: 5e-4, end: 1.0, kept: 12, points: 3, candidates: 16_000 },
];

/// The static shapes of two hands on a free body end at the region, and more columns gained
/// nothing: two that tear a bar by .3 were off by .16 % with fourteen, and by .09 % with these.
const TWO_ON_A_FREE_BODY: Effort =
    Effort { corrections: 6, enough: 5e-4, end: 1.0, kept: 8, points: 3, candidates: 4_000 };

/// The same around hands that are at rest.
const AT_REST: [Effort; HeldShapes::MAX_PATCHES] = [
    Effort { corrections: 3, enough: 5e-4, end: 1.0, kept: 6, points: 3, candidates: 4_000 },
    Effort { corrections: 3, enough: 5e-4, end: 1.0, kept: 8, points: 3, candidates: 4_000 },
    Effort { corrections: 3, enough: 5e-4, end: 1.0, kept: 10, points: 3, candidates: 4_000 },
    Effort { corrections: 3, enough: 5e-4, end: 1.0, kept: 12, points: 3, candidates: 4_000 },
];

/// Number of columns that each time adds.
const ADDED: usize = 6;

/// Number of points outside of the region that find shapes on the paths of hands. Inside, all
/// points do: with half of them, the shapes bend where no point is, and pressing hands are off by
/// 50 %.
const OUTSIDE: usize = 400;

/// Number of points from which those are taken.
const OUTSIDE_ALL: usize = 2_000;

/// The six directions in which hands are beside the ends of their paths.
const DIRECTIONS: [Vector3<f64>; 6] = [
    Vector3::new(1.0, 0.0, 0.0),
    Vector3::new(-1.0, 0.0, 0.0),
    Vector3::new(0.0, 1.0, 0.0),
    Vector3::new(0.0, -1.0, 0.0),
    Vector3::new(0.0, 0.0, 1.0),
    Vector3::new(0.0, 0.0, -1.0),
];

/// Shapes with `more` zeros after the first `width` entries.
fn widened(shapes: &[GuidedShape], width: usize, more: usize) -> Vec<GuidedShape> {
    let mut out = shapes.to_vec();
    for shape in &mut out {
        shape.q.splice(width..width, std::iter::repeat_n(0.0, more));
    }
    out
}

/// Columns on a region.
pub(super) struct Columns {
    /// Displacements `X`, `[node][axis][column]`.
    pub(super) values: Vec<f64>,
    pub(super) width: usize,
    /// The coordinates' part `P` that is taken out of them, `[coordinate][column]`.
    pub(super) parts: Vec<f64>,
}

impl Columns {
    /// Makes the static columns of all loads with those of second order, less the coordinates' part
    /// of them. Each has energy one and no two have energy together. Returns `None` if nothing is
    /// left.
    pub(super) fn new(
        model: &ModalModel,
        region: &Region<'_>,
        loads: &[NodeLoad],
        law: Hyperelastic,
    ) -> Option<Self> {
        let width = 9 * loads.len();
        let mut all = vec![0.0; 3 * region.node_count() * width];
        for (index, load) in loads.iter().enumerate() {
            let shapes = region.static_shapes(index, load, law);
            for (all, own) in all.chunks_exact_mut(width).zip(shapes.chunks_exact(9)) {
                all[9 * index..9 * (index + 1)].copy_from_slice(own);
            }
        }
        let energies = region.energies([&all, &all], [width; 2]);
        let scale: Vec<f64> = (0..width)
            .map(|k| energies[k * width + k])
            .map(|energy| if energy > 0.0 { 1.0 / energy.sqrt() } else { 0.0 })
            .collect();
        let scaled = DMatrix::from_fn(width, width, |i, j| {
            0.5 * scale[i] * scale[j] * (energies[i * width + j] + energies[j * width + i])
        });
        let mut combine = orthonormal(scaled, LEAST, width)?;
        for (mut row, scale) in combine.row_iter_mut().zip(&scale) {
            row *= *scale;
        }
        let values = combined(&all, &combine);
        let bare = Self { width: combine.ncols(), parts: Vec::new(), values };
        let energies = region.energies([&bare.values, &bare.values], [bare.width; 2]);
        bare.beside(model, region, &energies, NEW, usize::MAX, None)
    }

    /// Columns for hands that have led their patches by `displacements` (m): shapes on the way and
    /// around its end are corrected again and again. Of all columns, those that these shapes use
    /// most are kept. Returns the columns and the shapes.
    pub(super) fn corrected(
        self,
        model: &ModalModel,
        region: &Region<'_>,
        loads: &[NodeLoad],
        law: Hyperelastic,
        displacements: &[Vector3<f64>],
    ) -> Option<(Self, Vec<GuidedShape>)> {
        let mut columns = self;
        let points = columns.some_points(model, region);
        let mut shapes =
            led(model, law, &columns.omega(model), &points, &columns.rows(region, loads), displacements)?;
        let effort = Effort::of(displacements, region);
        for _ in 0..effort.corrections {
            let new = columns.corrections(model, region, loads, law, &shapes, (displacements, effort.end));
            let Some((new, share)) = new else { break };
            shapes = widened(&shapes, columns.width, new.width);
            columns = columns.with(&new);
            let points = columns.some_points(model, region);
            shapes = columns.refined(model, region, loads, law, &points, shapes)?;
            if share.is_some_and(|share| share <= effort.enough) {
                break;
            }
        }
        let (columns, shapes) =
            columns.compressed(&columns.rows(region, loads), model.omega(), shapes, effort.kept)?;
        let points = columns.some_points(model, region);
        let shapes = columns.refined(model, region, loads, law, &points, shapes)?;
        (!shapes.is_empty()).then_some((columns, shapes))
    }

    /// Keeps the static shapes of the patches and `keep` further combinations of columns that
    /// given shapes use most.
    fn compressed(
        &self,
        rows: &[Rows],
        omega: &[f64],
        shapes: Vec<GuidedShape>,
        keep: usize,
    ) -> Option<(Self, Vec<GuidedShape>)> {
        let width = self.width;
        // The columns have energy one each and none together: the static shape of a force is that
        // of its work on each column.
        let statics = DMatrix::from_fn(width, 3 * rows.len(), |i, k| rows[k / 3][k % 3][i]);
        let energy = |q: &[f64]| {
            let modal = q[width..].iter().zip(omega).map(|(q, omega)| (q * omega).powi(2)).sum::<f64>();
            modal + q[..width].iter().map(|s| s * s).sum::<f64>()
        };
        let used = DMatrix::from_fn(width, shapes.len(), |i, k| {
            let q = &shapes[k].q;
            q[i] / energy(q).max(f64::MIN_POSITIVE).sqrt()
        });
        let statics = orthonormal_basis(statics, 3 * rows.len(), 1e-6)?;
        let rest = &used - product(&statics, &product(&statics.transpose(), &used));
        let combine = match orthonormal_basis(rest, keep, 1e-6) {
            Some(more) => {
                let columns: Vec<_> =
                    statics.column_iter().chain(more.column_iter()).map(|c| c.into_owned()).collect();
                DMatrix::from_columns(&columns)
            }
            None => statics,
        };
        let out = Self {
            values: combined(&self.values, &combine),
            parts: combined(&self.parts, &combine),
            width: combine.ncols(),
        };
        let shapes = shapes.into_iter().map(|mut shape| {
            let s = DMatrix::from_row_slice(1, width, &shape.q[..width]) * &combine;
            shape.q.splice(..width, s.iter().copied());
            shape
        });
        let shapes = shapes.collect();
        Some((out, shapes))
    }

    /// Some points outside of the region and all inside.
    fn some_points(&self, model: &ModalModel, region: &Region<'_>) -> Vec<Point> {
        let outside = thinned(&region.outside(model.size(), OUTSIDE_ALL), OUTSIDE);
        let places = [outside, region.inside()].concat();
        region.points(&places, self, &region.node_rows(self))
    }

    /// Finds shapes anew, from where they were.
    fn refined(
        &self,
        model: &ModalModel,
        region: &Region<'_>,
        loads: &[NodeLoad],
        law: Hyperelastic,
        points: &[Point],
        shapes: Vec<GuidedShape>,
    ) -> Option<Vec<GuidedShape>> {
        let (omega, patches) = (self.omega(model), self.rows(region, loads));
        let mut energy = coarse(model, law, &omega, points)?;
        let refine = |shape: GuidedShape| {
            cubature::hold(&mut energy, &omega, &patches, &shape.there, &shape.q, REFINEMENTS)
        };
        Some(shapes.into_iter().filter_map(refine).collect())
    }

    /// Makes columns that correct shapes: the displacements by which a Newton step changes them,
    /// less what the columns and the coordinates have of them. Those with the largest shares of the
    /// energy are kept, where the shape at the ends of the paths counts `end_counts` times as much.
    /// Returns them with the share of its energy by which that shape is corrected, if there is one,
    /// and `None` if there are no columns.
    fn corrections(
        &self,
        model: &ModalModel,
        region: &Region<'_>,
        loads: &[NodeLoad],
        law: Hyperelastic,
        shapes: &[GuidedShape],
        (displacements, end_counts): (&[Vector3<f64>], f64),
    ) -> Option<(Self, Option<f64>)> {
        let (omega, width) = (self.omega(model), shapes.len());
        if width == 0 {
            return None;
        }
        let end = shapes.iter().position(|shape| shape.there == displacements);
        let mut values = region.corrections(loads, shapes, self, law, end.map(|end| &shapes[end].q[..]));
        // What matters is the share of a shape's energy that is corrected.
        let scales: Vec<f64> = shapes
            .iter()
            .map(|shape| shape.q.iter().zip(&omega).map(|(q, omega)| (q * omega).powi(2)).sum::<f64>())
            .enumerate()
            .map(|(shape, energy)| {
                let counts = if Some(shape) == end { end_counts } else { 1.0 };
                if energy > 0.0 { counts / energy.sqrt() } else { 0.0 }
            })
            .collect();
        for row in values.chunks_exact_mut(width) {
            row.iter_mut().zip(&scales).for_each(|(x, scale)| *x *= scale);
        }
        if !values.iter().all(|x| x.is_finite()) {
            return None;
        }
        let energies = region.energies([&values, &values], [width; 2]);
        let share = end.map(|end| energies[end * width + end] / end_counts.powi(2));
        let corrections = Self { values, width, parts: Vec::new() };
        let columns = corrections.beside(model, region, &energies, CORRECTION, ADDED, Some(self))?;
        Some((columns, share))
    }

    /// These columns and more.
    fn with(&self, new: &Self) -> Self {
        let joined = |a: &[f64], b: &[f64]| -> Vec<f64> {
            let rows = a.chunks_exact(self.width).zip(b.chunks_exact(new.width));
            rows.flat_map(|(a, b)| a.iter().chain(b).copied()).collect()
        };
        Self {
            values: joined(&self.values, &new.values),
            parts: joined(&self.parts, &new.parts),
            width: self.width + new.width,
        }
    }

    /// Takes the part of the coordinates, and of `others`, out of columns with given energies.
    /// Keeps at most `most` combinations of what is left, those with the largest energies and none
    /// below `least` of the largest (or of one, without others), and scales them to energy one.
    /// Returns `None` if nothing is left.
    fn beside(
        self,
        model: &ModalModel,
        region: &Region<'_>,
        energies: &[f64],
        least: f64,
        most: usize,
        others: Option<&Self>,
    ) -> Option<Self> {
        let (width, omega) = (self.width, model.omega());
        let mut parts = region.coupling(&self.values, width);
        for (row, omega) in parts.chunks_exact_mut(width).zip(omega) {
            row.iter_mut().for_each(|x| *x /= omega * omega);
        }
        let soft = |a: &[f64], [i, rows]: [usize; 2], j: usize| -> f64 {
            let pairs = a.chunks_exact(rows).zip(parts.chunks_exact(width)).zip(omega);
            pairs.map(|((a, b), omega)| omega * omega * a[i] * b[j]).sum()
        };
        let mut left = DMatrix::from_fn(width, width, |i, j| {
            0.5 * (energies[i * width + j] + energies[j * width + i]) - soft(&parts, [i, width], j)
        });
        let shared = others.map(|others| {
            let rows = others.width;
            let both = region.energies([&others.values, &self.values], [rows, width]);
            DMatrix::from_fn(rows, width, |i, j| both[i * width + j] - soft(&others.parts, [i, rows], j))
        });
        if let Some(shared) = &shared {
            left -= product(&shared.transpose(), shared);
        }
        let combine = orthonormal(left, least, most)?;
        let mut values = combined(&self.values, &combine);
        let mut parts = combined(&parts, &combine);
        if let (Some(others), Some(shared)) = (others, shared) {
            let theirs = product(&shared, &combine);
            // The others move nodes beyond the region too.
            values.resize(others.values.len() / others.width * combine.ncols(), 0.0);
            let take = |from: &mut [f64], rows: &[f64]| {
                from.iter_mut().zip(combined(rows, &theirs)).for_each(|(x, part)| *x -= part);
            };
            take(&mut values, &others.values);
            take(&mut parts, &others.parts);
        }
        let is_sound = values.iter().chain(&parts).all(|x| x.is_finite());
        is_sound.then_some(Self { values, width: combine.ncols(), parts })
    }

    /// Takes the coordinates' part out of a row of columns.
    pub(super) fn take_out(&self, modal: &[f64], row: &mut [f64]) {
        for (modal, parts) in modal.iter().zip(self.parts.chunks_exact(self.width)) {
            row.iter_mut().zip(parts).for_each(|(x, part)| *x -= modal * part);
        }
    }

    /// Computes `q - P s`.
    pub(super) fn less_part(&self, s: &[f64], q: &mut [f64]) {
        for (q, row) in q.iter_mut().zip(self.parts.chunks_exact(self.width)) {
            *q -= row.iter().zip(s).map(|(part, s)| part * s).sum::<f64>();
        }
    }

    /// Mean displacements of loads by columns and coordinates.
    pub(super) fn rows(&self, region: &Region<'_>, loads: &[NodeLoad]) -> Vec<Rows> {
        let row = |load| {
            let (mut own, modal) = region.mean(load, &self.values, self.width);
            own.iter_mut().zip(&modal).for_each(|(own, modal)| self.take_out(modal, own));
            std::array::from_fn(|axis: usize| own[axis].iter().chain(&modal[axis]).copied().collect())
        };
        loads.iter().map(row).collect()
    }

    /// Frequencies of columns and coordinates, rad/s.
    pub(super) fn omega(&self, model: &ModalModel) -> Vec<f64> {
        std::iter::repeat_n(1.0, self.width).chain(model.omega().iter().copied()).collect()
    }
}

/// The energy of some points.
fn coarse(model: &ModalModel, law: Hyperelastic, omega: &[f64], points: &[Point]) -> Option<ElasticEnergy> {
    let few = ReducedElasticity {
        material: model.material()?,
        weights: points.iter().map(|point| point.weight).collect(),
        gradients: points.iter().flat_map(|point| point.gradients.iter().map(|&x| x as f32)).collect(),
        mesh: None,
    };
    ElasticEnergy::new(&few, law, omega).ok()
}

/// Finds the shapes in which all patches are led by shares of `displacements` (m), and those in
/// which one of them is a little beside the end of its path.
fn led(
    model: &ModalModel,
    law: Hyperelastic,
    omega: &[f64],
    points: &[Point],
    patches: &[Rows],
    displacements: &[Vector3<f64>],
) -> Option<Vec<GuidedShape>> {
    let mut energy = coarse(model, law, omega, points)?;
    let mut out: Vec<GuidedShape> = Vec::new();
    let mut q = vec![0.0; omega.len()];
    let mut end = q.clone();
    let far = displacements.iter().map(|u| u.norm()).fold(0.0, f64::max);
    for share in SHARES.into_iter().filter(|_| far > 0.0) {
        let there: Vec<Vector3<f64>> = displacements.iter().map(|u| share * u).collect();
        let Some(shape) = cubature::hold(&mut energy, omega, patches, &there, &q, cubature::ROUNDS) else {
            break;
        };
        q.clone_from(&shape.q);
        if share <= 1.0 {
            end.clone_from(&shape.q);
        }
        out.push(shape);
    }
    let most = ENERGY * model.info().young * energy.volume();
    let beside = (BESIDE[0] * far).max(BESIDE[1] * model.size());
    for index in 0..patches.len() {
        for direction in &DIRECTIONS {
            let mut there = displacements.to_vec();
            there[index] += beside * direction;
            if let Some(shape) = cubature::hold(&mut energy, omega, patches, &there, &end, cubature::ROUNDS) {
                // Hands side by side would be torn apart.
                if energy.energy(&shape.q) <= most {
                    out.push(shape);
                }
            }
        }
    }
    Some(out)
}

/// The product of two matrices. Its sums have a fixed order without fused products, so that it is
/// the same on every machine.
fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let entry = |i, j| (0..a.ncols()).map(|k| a[(i, k)] * b[(k, j)]).sum();
    DMatrix::from_fn(a.nrows(), b.ncols(), entry)
}

/// Orthonormal columns that span a matrix: at most `most`, and none whose singular value is below
/// `least` of the largest. Returns `None` for a matrix of zeros.
fn orthonormal_basis(matrix: DMatrix<f64>, most: usize, least: f64) -> Option<DMatrix<f64>> {
    let gram = product(&matrix, &matrix.transpose());
    if !gram.iter().all(|x| x.is_finite()) {
        return None;
    }
    let eigen = gram.symmetric_eigen();
    let top = eigen.eigenvalues.max();
    let mut order: Vec<usize> = (0..eigen.eigenvalues.len())
        .filter(|&k| eigen.eigenvalues[k] > least * least * top && top > 0.0)
        .collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    order.truncate(most);
    let columns: Vec<_> = order.iter().map(|&k| eigen.eigenvectors.column(k).into_owned()).collect();
    (!columns.is_empty()).then(|| DMatrix::from_columns(&columns))
}

/// The combinations of columns that have energy one each and none together, given the energies of
/// all pairs. Those with less than a share of the largest energy end, and all but the `most` with
/// the largest energies.
fn orthonormal(energies: DMatrix<f64>, least: f64, most: usize) -> Option<DMatrix<f64>> {
    if !energies.iter().all(|x| x.is_finite()) {
        return None;
    }
    let width = energies.ncols();
    let eigen = energies.symmetric_eigen();
    let top = eigen.eigenvalues.max();
    let mut kept: Vec<usize> =
        (0..width).filter(|&k| eigen.eigenvalues[k] > least * top && top > 0.0).collect();
    kept.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    kept.truncate(most);
    if kept.is_empty() {
        return None;
    }
    Some(DMatrix::from_fn(width, kept.len(), |row, column| {
        let k = kept[column];
        eigen.eigenvectors[(row, k)] / eigen.eigenvalues[k].sqrt()
    }))
}

/// Combines columns of a matrix that is stored row by row.
fn combined(rows: &[f64], combine: &DMatrix<f64>) -> Vec<f64> {
    let entry =
        |row: &[f64], column: usize| row.iter().zip(combine.column(column).iter()).map(|(x, c)| x * c).sum();
    let rows = rows.chunks_exact(combine.nrows());
    rows.flat_map(|row| (0..combine.ncols()).map(move |column| entry(row, column))).collect()
}

//! Columns of held patches: displacements of a region in which the coordinates have no part.

use nalgebra::{DMatrix, Vector3};

use super::{
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

/// Most columns that correct those of second order: of one patch, and of all patches together.
/// Every column makes the step longer.
const MAX_CORRECTIONS: [usize; 2] = [9, 12];

/// Corrections whose energy is a smaller share than this of that of the shapes end.
const CORRECTION: f64 = 1e-8;

/// Largest energy density of a training shape, as a share of Young's modulus.
const ENERGY: f64 = 0.02;

/// Ways of a hand in training shapes, as shares of the body's size.
const WAYS: [f64; 5] = [0.04, 0.08, 0.16, 0.3, 0.5];

/// Ways of shapes that are not corrected begin here.
const FAR: f64 = 0.4;

/// Number of points, outside and inside the region, that find the shapes that are corrected.
const POINTS: [usize; 2] = [200, 400];

/// Number of points, outside and inside the region, that find the same shapes with the columns that
/// correct them.
const COARSE: [usize; 2] = [150, 300];

/// Number of Newton rounds that find a shape anew with more columns.
const AGAIN: usize = 2;

/// Number of points outside of which those are taken.
const OUTSIDE: usize = 2_000;

/// The six directions in which hands go in training shapes.
const DIRECTIONS: [Vector3<f64>; 6] = [
    Vector3::new(1.0, 0.0, 0.0),
    Vector3::new(-1.0, 0.0, 0.0),
    Vector3::new(0.0, 1.0, 0.0),
    Vector3::new(0.0, -1.0, 0.0),
    Vector3::new(0.0, 0.0, 1.0),
    Vector3::new(0.0, 0.0, -1.0),
];

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

    /// Adds columns that correct shapes in which the hands pull far: the displacements by which a
    /// Newton step changes them, less what the columns and the coordinates have of them. The
    /// corrections with the largest shares of the energy are kept. Returns the columns and the
    /// shapes, each with the index of its patch.
    pub(super) fn corrected(
        self,
        model: &ModalModel,
        region: &Region<'_>,
        loads: &[NodeLoad],
        law: Hyperelastic,
    ) -> Option<(Self, Vec<(usize, GuidedShape)>)> {
        let outside = thinned(&region.outside(model.size(), OUTSIDE), POINTS[0]);
        let places = [outside, thinned(&region.inside(), POINTS[1])].concat();
        let points = region.points(&places, &self, &region.node_rows(&self));
        let patches = self.rows(region, loads);
        let omega = self.omega(model);
        let guided = guided(model, law, &omega, &points, &patches)?;
        let mut blocks = Vec::new();
        for (index, load) in loads.iter().enumerate() {
            let own: Vec<&GuidedShape> =
                guided.iter().filter(|(patch, _)| *patch == index).map(|(_, shape)| shape).collect();
            let near = |shape: &&GuidedShape| shape.there.norm() < FAR * model.size();
            let own: Vec<&GuidedShape> = own.into_iter().filter(near).collect();
            let cases = own.len();
            if cases == 0 {
                continue;
            }
            let mut found = region.corrections(index, load, &own, &self, law);
            // What matters is the share of a shape's energy that is corrected.
            let scales: Vec<f64> = own
                .iter()
                .map(|shape| shape.q.iter().zip(&omega).map(|(q, omega)| (q * omega).powi(2)).sum::<f64>())
                .map(|energy| if energy > 0.0 { 1.0 / energy.sqrt() } else { 0.0 })
                .collect();
            for row in found.chunks_exact_mut(cases) {
                row.iter_mut().zip(&scales).for_each(|(x, scale)| *x *= scale);
            }
            blocks.push((found, cases));
        }
        let width = blocks.iter().map(|(_, cases)| cases).sum();
        if width == 0 {
            return Some((self, guided));
        }
        let mut values: Vec<f64> = Vec::with_capacity(3 * region.node_count() * width);
        for row in 0..3 * region.node_count() {
            for (block, cases) in &blocks {
                values.extend(&block[row * cases..][..*cases]);
            }
        }
        if !values.iter().all(|x| x.is_finite()) {
            return Some((self, guided));
        }
        let most = if loads.len() == 1 { MAX_CORRECTIONS[0] } else { MAX_CORRECTIONS[1] };
        let energies = region.energies([&values, &values], [width; 2]);
        let corrections = Self { values, width, parts: Vec::new() };
        let Some(new) = corrections.beside(model, region, &energies, CORRECTION, most, Some(&self)) else {
            return Some((self, guided));
        };
        let joined = |a: &[f64], b: &[f64]| -> Vec<f64> {
            let rows = a.chunks_exact(self.width).zip(b.chunks_exact(new.width));
            rows.flat_map(|(a, b)| a.iter().chain(b).copied()).collect()
        };
        let all = Self {
            values: joined(&self.values, &new.values),
            parts: joined(&self.parts, &new.parts),
            width: self.width + new.width,
        };
        let mut guided = guided;
        for (_, shape) in &mut guided {
            shape.q.splice(self.width..self.width, std::iter::repeat_n(0.0, new.width));
        }
        let (inside, outside) = (region.inside(), region.outside(model.size(), OUTSIDE));
        let places = [thinned(&outside, COARSE[0]), thinned(&inside, COARSE[1])].concat();
        let points = region.points(&places, &all, &region.node_rows(&all));
        let (omega, patches) = (all.omega(model), all.rows(region, loads));
        let (mut energy, most) = coarse(model, law, &omega, &points)?;
        let again = |(patch, shape): (usize, GuidedShape)| {
            let found =
                cubature::hold(&mut energy, &omega, patches.get(patch)?, &shape.there, &shape.q, AGAIN)?;
            let reached = energy.energy(&found.q);
            (reached <= most).then_some((patch, found))
        };
        let found = guided.into_iter().filter_map(again).collect();
        Some((all, found))
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
            left -= shared.transpose() * shared;
        }
        let combine = orthonormal(left, least, most)?;
        let mut values = combined(&self.values, &combine);
        let mut parts = combined(&parts, &combine);
        if let (Some(others), Some(shared)) = (others, shared) {
            let theirs = shared * &combine;
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

/// The energy of some points, and the most that a training shape may have of it, J.
fn coarse(
    model: &ModalModel,
    law: Hyperelastic,
    omega: &[f64],
    points: &[Point],
) -> Option<(ElasticEnergy, f64)> {
    let few = ReducedElasticity {
        material: model.material()?,
        weights: points.iter().map(|point| point.weight).collect(),
        gradients: points.iter().flat_map(|point| point.gradients.iter().map(|&x| x as f32)).collect(),
        mesh: None,
    };
    let energy = ElasticEnergy::new(&few, law, omega).ok()?;
    let most = ENERGY * model.info().young * energy.volume();
    Some((energy, most))
}

/// Finds the shapes in which each patch is led along the axes, with the energy of some points.
/// Returns them with the indices of their patches.
fn guided(
    model: &ModalModel,
    law: Hyperelastic,
    omega: &[f64],
    points: &[Point],
    patches: &[Rows],
) -> Option<Vec<(usize, GuidedShape)>> {
    let (mut energy, most) = coarse(model, law, omega, points)?;
    let ways = WAYS.map(|way| way * model.size());
    let mut out = Vec::new();
    for (index, patch) in patches.iter().enumerate() {
        for direction in &DIRECTIONS {
            let led = cubature::guided_shapes(&mut energy, omega, patch, direction, &ways, most);
            out.extend(led.into_iter().map(|shape| (index, shape)));
        }
    }
    Some(out)
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

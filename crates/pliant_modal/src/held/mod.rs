//! The own shapes of held patches: what the coordinates of a model leave out around a hand.
//!
//! The coordinates of a reduced model are smooth. Around a held patch the body also bends in the
//! way that the hand forces on it: the three static shapes of a force on the patch, and the six
//! shapes of second order of their pairs (modal derivatives of the static shapes, S. R. Idelsohn
//! and A. Cardona, *A reduction method for nonlinear structural dynamic analysis*, CMAME 49, 1985).
//! These columns are solved on the region, which is the elements around the patches, when a hand
//! takes hold, and vanish beyond it. The static shapes of two hands on an anchored body reach over
//! all of it. What
//! the coordinates have of the columns is then taken out, so that coordinates mean the same with
//! and without them:
//!
//! ```text
//! u = Phi q + (X - Phi P) s,   P = Lambda^-1 Phi^T K X
//! ```
//!
//! These are the residual attachment modes of substructuring (R. R. Craig and C.-J. Chang, *On the
//! use of attachment modes in substructure coupling for dynamic analysis*, 1977). Together with the
//! coordinates they get a cubature rule of their own.
//!
//! Where a hand pulls far, shapes of second order are not enough. The body is therefore led to
//! where the hands are, and the displacements by which a Newton step of the full elements corrects
//! it there are further columns, again and again: the columns follow the hands. Those that the
//! shapes on the way use most are kept. When a hand has gone on, the columns are made anew.
//!
//! A body also gives way beyond the region, where the columns end. By what the patch's own
//! flexibility is larger for it than that of the columns, a compliance stays between the patch and
//! a single hand.
//!
//! The columns have no mass: their coordinates `s` are those of least energy in every step.

mod columns;
mod elastic;
mod mesh;
mod region;
mod stiffness;

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

pub use mesh::{SimulationMesh, VertexPlace};

use self::{
    columns::{Columns, Effort},
    region::{NodeLoad, Region, WeightedPoint},
};
use crate::{
    Hand, HeldPatch, Hyperelastic, ModalModel, ModelHash, Patch, StepError,
    cubature::{self, Fit, GuidedShape, Point},
    nonlinear::Gradients,
    step::{contact_floor, residual},
};

/// What the body gives beyond the region does not count below the first share of the compliance of
/// a patch in a direction, and all of it counts from the second on.
const BEYOND: [f64; 2] = [0.025, 0.05];

/// Number of points outside of the region to choose from.
const OUTSIDE: usize = 400;

/// Largest number of points outside of the region whose forces are the reference. A reference of
/// one point in nine was off by two percent of the force in the hand.
const REFERENCE: usize = 24_000;

/// Error of the forces over the training shapes at which no more points are added.
const TOLERANCE: f64 = 3e-3;

/// What identifies a patch of a model: its center and its radius.
pub(crate) type PatchKey = (u32, u64);

/// Returns what identifies a patch.
pub(crate) fn key(patch: &Patch) -> PatchKey {
    (patch.center(), patch.radius().to_bits())
}

/// A patch that a hand holds, and where the hand has led it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldPlace {
    /// Center vertex of the patch.
    pub vertex: u32,
    /// Radius of the patch, m.
    pub radius: f64,
    /// Mean displacement of the patch from rest, m, body axes.
    pub displacement: [f64; 3],
}

impl HeldPlace {
    /// What identifies the patch.
    pub(crate) fn key(&self) -> PatchKey {
        (self.vertex, self.radius.to_bits())
    }
}

/// Hands that are farther from where shapes were made than this share of the body's size, and than
/// this share of the longest displacement besides, need others.
const NEAR: f64 = 0.02;
const NEAR_SHARE: f64 = 0.1;

/// The own shapes of the patches that hands hold on a body with reduced elasticity.
///
/// They are made for where the hands are, which takes half a second to ten seconds, and shared by
/// all copies of the body.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldShapes {
    model: ModelHash,
    keys: Vec<PatchKey>,
    /// Where hands have led the patches, m, body axes.
    patch_displacements: Vec<Vector3<f64>>,
    /// Mean displacement of each patch by the columns, `[axis][column]`, m.
    rows: Vec<cubature::Rows>,
    /// Compliance of each patch at the baked stiffness that neither coordinates nor columns have,
    /// m/N, body axes.
    residuals: Vec<Matrix3<f64>>,
    columns: usize,
    /// The coordinates' part `P` that is taken out of each column, `[coordinate][column]`.
    parts: Vec<f64>,
    /// The rule, with the columns before the coordinates.
    gradients: Arc<Gradients>,
    weights: Vec<f64>,
    /// Surface vertices that the columns move, and by how much, `[vertex][axis][column]`.
    vertices: Vec<u32>,
    displacements: Vec<f32>,
}

impl HeldShapes {
    /// Largest number of patches whose shapes a body has at a time. Shapes of more hands would make
    /// a step too long.
    pub const MAX_PATCHES: usize = 4;

    /// Makes the shapes of patches that are at rest. The result is the same on every machine.
    ///
    /// Returns `None` for a model without reduced elasticity or without its simulation mesh, for no
    /// patch and for more than four, for patches that nothing moves, and for a free body that is no
    /// larger than the region around a patch, where nothing holds the shapes.
    ///
    /// # Errors
    /// Returns [`StepError::Vertex`] if a patch belongs to another surface.
    pub fn new(model: &ModalModel, patches: &[Patch]) -> Result<Option<Self>, StepError> {
        Self::of_patches(model, patches, &vec![Vector3::zeros(); patches.len()])
    }

    /// Makes the shapes that patches need where hands have led them. See [`HeldShapes::new`].
    ///
    /// # Errors
    /// Returns [`StepError::Vertex`] if the model has no such patch.
    pub fn of_places(model: &ModalModel, places: &[HeldPlace]) -> Result<Option<Self>, StepError> {
        let count = model.surface().positions().len();
        let patch = |place: &HeldPlace| {
            let vertex = place.vertex;
            Patch::around(model.surface(), vertex, place.radius)
                .map_err(|_| StepError::Vertex { vertex, count })
        };
        let patches = places.iter().map(patch).collect::<Result<Vec<_>, _>>()?;
        let displacements: Vec<Vector3<f64>> = places.iter().map(|place| place.displacement.into()).collect();
        Self::of_patches(model, &patches, &displacements)
    }

    /// Returns the places that a body needs shapes for, where those that it has do not suffice:
    /// they are of other patches, or hands have gone farther than a fiftieth of the size and a
    /// tenth of their displacement since. Those of more patches suffice: a body that one of two
    /// hands has let go is far from where shapes of the other one alone serve. No places: the body
    /// needs no shapes any more.
    ///
    /// At most [`HeldShapes::MAX_PATCHES`] of the places get shapes. They are in a fixed order, and
    /// their displacements are rounded, so that equal and nearby ones share their shapes.
    pub fn wanted(
        model: &ModalModel,
        held: impl IntoIterator<Item = HeldPlace>,
        own: Option<&Self>,
    ) -> Option<Vec<HeldPlace>> {
        let mut places: Vec<HeldPlace> = held.into_iter().take(Self::MAX_PATCHES).collect();
        places.sort_unstable_by_key(HeldPlace::key);
        places.dedup_by_key(|place| place.key());
        for displacement in places.iter_mut().map(|place| &mut place.displacement) {
            if !displacement.iter().all(|x| x.is_finite()) {
                *displacement = [0.0; 3];
            }
        }
        let size = model.size();
        let serves = |own: &Self| {
            let made_for = |place: &HeldPlace| {
                let index = own.keys.iter().position(|key| *key == place.key());
                index.and_then(|index| own.patch_displacements.get(index))
            };
            let farthest = places.iter().filter_map(made_for).map(|u| u.norm()).fold(0.0, f64::max);
            let near = |place: &HeldPlace| {
                made_for(place).is_some_and(|displacement| {
                    (Vector3::from(place.displacement) - displacement).norm()
                        <= NEAR * size + NEAR_SHARE * farthest
                })
            };
            !places.is_empty() && places.iter().all(near)
        };
        if own.map_or(places.is_empty(), serves) {
            return None;
        }
        for place in &mut places {
            place.displacement = place.displacement.map(|x| (x / (NEAR * size)).round() * NEAR * size);
        }
        Some(places)
    }

    fn of_patches(
        model: &ModalModel,
        patches: &[Patch],
        patch_displacements: &[Vector3<f64>],
    ) -> Result<Option<Self>, StepError> {
        let count = model.surface().positions().len();
        for patch in patches {
            if let Some(&(vertex, _)) = patch.entries().iter().find(|&&(v, _)| v as usize >= count) {
                return Err(StepError::Vertex { vertex, count });
            }
        }
        let Some(reduced) = model.parts().reduced.as_ref() else { return Ok(None) };
        let Some(mesh) = &reduced.mesh else { return Ok(None) };
        if patches.is_empty() || patches.len() > Self::MAX_PATCHES {
            return Ok(None);
        }
        let positions = model.surface().positions();
        let middle = |patch: &Patch| -> Vector3<f64> {
            let at = |v: u32| Vector3::from(positions[v as usize].map(f64::from));
            patch.entries().iter().map(|&(v, weight)| weight * at(v)).sum()
        };
        let places: Vec<(Vector3<f64>, f64)> = patches.iter().map(|p| (middle(p), p.radius())).collect();
        let law = model.law(reduced.material, 1.0);
        let region = Region::new(mesh, model.info().element, law, &places, model.size());
        if !region.is_held() {
            return Ok(None);
        }
        let loads: Vec<NodeLoad> = patches.iter().map(|patch| region.load(patch)).collect();
        let columns = Columns::new(model, &region, &loads, law)
            .and_then(|columns| columns.corrected(model, &region, &loads, law, patch_displacements));
        let Some((columns, shapes)) = columns else { return Ok(None) };
        let width = columns.width;
        let whole = columns.rows(&region, &loads);
        if !whole.iter().flatten().flatten().all(|x| x.is_finite()) {
            return Ok(None);
        }
        let own = |rows: &cubature::Rows| rows.each_ref().map(|row| row[..width].to_vec());
        let rows: Vec<cubature::Rows> = whole.iter().map(own).collect();
        let left =
            |(patch, rows): (&Patch, &cubature::Rows)| left_out(model, patch, rows, patches.len() == 1);
        let residuals = patches.iter().zip(&rows).map(left).collect::<Result<_, _>>()?;
        let effort = Effort::of(patch_displacements, &region);
        let Some(rule) = rule(model, &region, law, (&columns, &shapes), effort) else { return Ok(None) };
        let omega = columns.omega(model);
        let (mut vertices, mut displacements) = (Vec::new(), Vec::new());
        let mut at = vec![0.0; 3 * width];
        for vertex in 0..count as u32 {
            if region.columns_at(vertex, &columns.values, width, &mut at) {
                vertices.push(vertex);
                displacements.extend(at.iter().map(|&x| x as f32));
            }
        }
        let gradients: Vec<f32> =
            rule.iter().flat_map(|point| point.gradients.iter().map(|&x| x as f32)).collect();
        let weights = rule.iter().map(|point| point.weight).collect();
        let gradients = Arc::new(Gradients::new(&gradients, &omega));
        let (model_hash, keys) = (model.hash(), patches.iter().map(key).collect());
        Ok(Some(Self {
            model: model_hash,
            keys,
            patch_displacements: patch_displacements.to_vec(),
            rows,
            residuals,
            columns: width,
            parts: columns.parts,
            gradients,
            weights,
            vertices,
            displacements,
        }))
    }

    /// Whether these are shapes of a model.
    pub(crate) fn are_of_model(&self, model: &ModalModel) -> bool {
        self.model == model.hash()
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Number of points of the rule.
    pub fn points(&self) -> usize {
        self.weights.len()
    }

    /// The patches, and where the hands had led them when the shapes were made.
    pub fn places(&self) -> impl ExactSizeIterator<Item = HeldPlace> + '_ {
        self.keys.iter().zip(&self.patch_displacements).map(|(&(vertex, radius), &displacement)| HeldPlace {
            vertex,
            radius: f64::from_bits(radius),
            displacement: displacement.into(),
        })
    }

    /// Mean displacement of a patch by the columns at `s`, m, body axes, besides that by the
    /// coordinates. `None` for another patch, and if `s` has not one entry per column.
    pub fn mean(&self, vertex: u32, radius: f64, s: &[f64]) -> Option<[f64; 3]> {
        let index = self.keys.iter().position(|key| *key == (vertex, radius.to_bits()))?;
        let dot = |row: &Vec<f64>| row.iter().zip(s).map(|(u, s)| u * s).sum();
        (s.len() == self.columns).then(|| self.rows[index].each_ref().map(dot))
    }

    /// Whether others are of the same patches, in any order.
    pub(crate) fn are_of_patches_of(&self, other: &Self) -> bool {
        self.keys.len() == other.keys.len() && self.keys.iter().all(|key| other.keys.contains(key))
    }

    /// Whether hands hold all of the patches.
    pub(crate) fn are_all_held(&self, hands: &[Hand]) -> bool {
        self.keys.iter().all(|key| hands.iter().any(|hand| hand.patch.key() == *key))
    }

    fn find(&self, patch: &HeldPatch) -> Option<usize> {
        self.keys.iter().position(|own| *own == patch.key())
    }

    /// Mean displacement of a patch by the columns, `[axis][column]`, m.
    pub(crate) fn rows(&self, patch: &HeldPatch) -> Option<&cubature::Rows> {
        self.rows.get(self.find(patch)?)
    }

    /// Displacement of a patch by the columns, m, body axes. `s` has one entry per column.
    pub(crate) fn displacement(&self, patch: &HeldPatch, s: &[f64]) -> Vector3<f64> {
        let (vertex, radius) = patch.center_and_radius();
        self.mean(vertex, radius, s).unwrap_or_default().into()
    }

    /// What is left of the residual flexibility of a patch at the baked stiffness, m/N.
    pub(crate) fn residual(&self, patch: &HeldPatch) -> Option<Matrix3<f64>> {
        self.residuals.get(self.find(patch)?).copied()
    }

    /// Takes the coordinates' part out of coordinates that draw a surface: `q - P s`. The columns'
    /// own part of the surface is [`HeldShapes::add_to`].
    pub fn draw(&self, s: &[f64], q: &mut [f64]) {
        if s.len() == self.columns {
            for (q, row) in q.iter_mut().zip(self.parts.chunks_exact(self.columns)) {
                *q -= row.iter().zip(s).map(|(part, s)| part * s).sum::<f64>();
            }
        }
    }

    /// The rule: gradients and weights, with the columns before the coordinates.
    pub(crate) fn rule(&self) -> (Arc<Gradients>, &[f64]) {
        (self.gradients.clone(), &self.weights)
    }

    /// Surface vertices that the columns move, ascending.
    pub fn vertices(&self) -> &[u32] {
        &self.vertices
    }

    /// Displacements of [`HeldShapes::vertices`] by the columns at `s`, m, body axes, besides those
    /// of the coordinates. They are zero if `s` has not one entry per column.
    pub fn displacements<'a>(&'a self, s: &'a [f64]) -> impl Iterator<Item = [f32; 3]> + 'a {
        let is_sound = s.len() == self.columns;
        self.displacements.chunks_exact(3 * self.columns).map(move |rows| {
            let mut out = [0.0; 3];
            if is_sound {
                for (out, row) in out.iter_mut().zip(rows.chunks_exact(self.columns)) {
                    *out = row.iter().zip(s).map(|(u, s)| u * *s as f32).sum();
                }
            }
            out
        })
    }

    /// Adds the displacements by the columns to a surface, m. `s` has one entry per column.
    pub fn add_to(&self, s: &[f64], surface: &mut [[f32; 3]]) {
        for (&vertex, moved) in self.vertices.iter().zip(self.displacements(s)) {
            if let Some(position) = surface.get_mut(vertex as usize) {
                position.iter_mut().zip(moved).for_each(|(x, moved)| *x += moved);
            }
        }
    }
}

/// What the columns, whose static compliance is that of `rows`, leave of the residual flexibility
/// of a patch at the baked stiffness, m/N, body axes. It has no negative part.
///
/// It is what the body gives beyond the region, where the columns end. The baked flexibility is
/// interpolated, so that a small share of the whole compliance is no more than its error. It counts
/// for a single hand only: what one of several hands moves there, the others move too, so that four
/// hands that twist the end of a bar, whose forces have no sum, were off by 16 % with their own
/// parts of it.
fn left_out(
    model: &ModalModel,
    patch: &Patch,
    rows: &cubature::Rows,
    is_single: bool,
) -> Result<Matrix3<f64>, StepError> {
    let floor = Matrix3::identity() * contact_floor(model, patch);
    if !is_single {
        return Ok(floor);
    }
    let whole = residual(model, patch, 0)? - floor;
    let flexibility = residual(model, patch, model.mode_count())? - floor;
    let dot = |i: usize, j: usize| rows[i].iter().zip(&rows[j]).map(|(a, b)| a * b).sum::<f64>();
    let left = flexibility - Matrix3::from_fn(dot);
    // In axes in which the whole compliance is one, what is left is a share of it.
    let Some(whole) = whole.cholesky() else { return Ok(floor) };
    let lower = whole.l();
    let Some(inverse) = lower.try_inverse() else { return Ok(floor) };
    let left = inverse * left * inverse.transpose();
    if !left.iter().all(|x| x.is_finite()) {
        return Ok(floor);
    }
    let eigen = left.symmetric_eigen();
    let [none, all] = BEYOND;
    let shares = eigen.eigenvalues.map(|x| x.max(0.0) * ((x - none) / (all - none)).clamp(0.0, 1.0));
    let turn = lower * eigen.eigenvectors;
    let more = turn * Matrix3::from_diagonal(&shares) * turn.transpose();
    Ok(floor + more)
}

/// Makes the rule of columns and coordinates, from training shapes. Returns `None` without any.
fn rule(
    model: &ModalModel,
    region: &Region<'_>,
    law: Hyperelastic,
    (columns, shapes): (&Columns, &[GuidedShape]),
    effort: &Effort,
) -> Option<Vec<Point>> {
    let omega = columns.omega(model);
    let m = omega.len();
    let outside = region.outside(model.size(), REFERENCE);
    let shapes: Vec<Vec<f64>> = shapes.iter().map(|shape| shape.q.clone()).collect();
    let forces = region.forces(columns, &shapes, law, &outside);
    // Columns and coordinates are orthogonal to each other in the stiffness at rest.
    let mut stiffness = vec![0.0; m * m];
    omega.iter().enumerate().for_each(|(i, omega)| stiffness[i * m + i] = omega * omega);
    let fit = Fit {
        law,
        omega: &omega,
        shapes: &shapes,
        forces: &forces,
        stiffness: &stiffness,
        tolerance: TOLERANCE,
        most: effort.points * m,
    };
    let places = [thinned(&outside, OUTSIDE), thinned(&region.inside(), effort.candidates)].concat();
    let candidates = region.points(&places, columns, &region.node_rows(columns));
    let chosen = cubature::choose(&candidates, &fit);
    let point = |(index, factor): (usize, f64)| {
        let point = &candidates[index];
        Point { weight: factor * point.weight, gradients: point.gradients.clone() }
    };
    let chosen: Vec<Point> = chosen.into_iter().map(point).collect();
    let sound = chosen.iter().all(|p| p.weight > 0.0 && p.weight.is_finite());
    (sound && !chosen.is_empty()).then_some(chosen)
}

/// Returns about `most` of the points, evenly from the list, with weights whose sum stays.
fn thinned(places: &[WeightedPoint], most: usize) -> Vec<WeightedPoint> {
    let stride = places.len().div_ceil(most).max(1);
    let groups = places.chunks(stride).enumerate();
    groups
        .map(|(group, members)| {
            let weight = members.iter().map(|place| place.weight).sum();
            WeightedPoint { weight, ..members[(group * 7919) % members.len()] }
        })
        .collect()
}

//! The data besides the modes that drawing a model needs, shared by bodies that are drawn alike.

use std::{
    collections::HashMap,
    sync::{Arc, Weak},
};

use bevy::{camera::primitives::Aabb, math::Vec3A, prelude::*};
use pliant_modal::{ModalModel, ModelHash};

use super::topology::Topology;

/// Number of parts along each axis into which a surface is divided for its bounds.
const PARTS: usize = 2;

/// The drawing data of a model.
#[derive(Debug)]
pub(super) struct Drawing {
    pub model: Arc<ModalModel>,
    pub topology: Topology,
    /// For each mode, the largest displacement of any vertex per unit of the modal coordinate,
    /// kg^-1/2: `|u| <= sum |q_k| reach_k`, with or without warping, because no singular value of
    /// `R~` exceeds one.
    pub reach: Vec<f32>,
    /// For each mode, the largest rotation of any vertex per unit of the modal coordinate,
    /// rad / (kg^1/2 m).
    pub turn: Vec<f32>,
    parts: Vec<DrawnPart>,
}

/// A part of the surface with its box at rest and its own reach.
#[derive(Debug)]
struct DrawnPart {
    low: Vec3A,
    high: Vec3A,
    reach: Vec<f32>,
}

impl Drawing {
    fn new(model: &Arc<ModalModel>, crease: f32) -> Self {
        let surface = model.surface();
        let positions = surface.positions();
        let parts = model.parts();
        let [low, high] = surface.bounds();
        let part_of = |p: &[f32; 3]| {
            (0..3).fold(0, |part, axis| {
                let across = (p[axis] - low[axis]) / (high[axis] - low[axis]);
                // A flat surface gives NaN here, which selects the first part.
                part * PARTS + ((across * PARTS as f32) as usize).min(PARTS - 1)
            })
        };
        let owners: Vec<usize> = positions.iter().map(part_of).collect();
        let modes = model.mode_count();
        let mut pieces: Vec<DrawnPart> = (0..PARTS * PARTS * PARTS)
            .map(|_| DrawnPart { low: Vec3A::INFINITY, high: Vec3A::NEG_INFINITY, reach: vec![0.0; modes] })
            .collect();
        for (p, &owner) in positions.iter().zip(&owners) {
            pieces[owner].low = pieces[owner].low.min(Vec3A::from(*p));
            pieces[owner].high = pieces[owner].high.max(Vec3A::from(*p));
        }
        let longest =
            |rows: &[f32]| rows.chunks_exact(3).map(|u| Vec3::from_slice(u).length()).fold(0.0, f32::max);
        let stride = 3 * positions.len();
        for (mode, rows) in parts.displacement.chunks_exact(stride).enumerate() {
            for (u, &owner) in rows.chunks_exact(3).zip(&owners) {
                let reach = &mut pieces[owner].reach[mode];
                *reach = reach.max(Vec3::from_slice(u).length());
            }
        }
        pieces.retain(|part| part.low.cmple(part.high).all());
        Self {
            topology: Topology::new(surface, crease),
            reach: parts.displacement.chunks_exact(stride).map(longest).collect(),
            turn: parts.rotation.chunks_exact(stride).map(longest).collect(),
            parts: pieces,
            model: model.clone(),
        }
    }

    /// Returns bounds that contain the surface at `q`, with or without warping, at the cost of a
    /// few numbers per mode.
    pub fn bounds(&self, q: &[f64]) -> Aabb {
        let (mut low, mut high) = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
        for part in &self.parts {
            let reach: f64 = q.iter().zip(&part.reach).map(|(q, &reach)| q.abs() * f64::from(reach)).sum();
            low = low.min(part.low - reach as f32);
            high = high.max(part.high + reach as f32);
        }
        Aabb::from_min_max(low.into(), high.into())
    }
}

/// The drawing data in use, by model and crease angle.
#[derive(Resource, Default)]
pub(super) struct Drawings(HashMap<(ModelHash, u32), Weak<Drawing>>);

impl Drawings {
    pub fn get(&mut self, model: &Arc<ModalModel>, crease: f32) -> Arc<Drawing> {
        let key = (model.hash(), crease.to_bits());
        if let Some(drawing) = self.0.get(&key).and_then(Weak::upgrade) {
            return drawing;
        }
        self.0.retain(|_, drawing| drawing.strong_count() > 0);
        let drawing = Arc::new(Drawing::new(model, crease));
        self.0.insert(key, Arc::downgrade(&drawing));
        drawing
    }
}

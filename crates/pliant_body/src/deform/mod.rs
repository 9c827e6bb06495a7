//! The deformed surface on screen: a [`Mesh`] a body, rewritten when its shown state moved and somebody sees it.
//!
//! The mesh is an ordinary one, so every material, shadow and prepass works on it unchanged. This module decides *what* is to be drawn
//! again and keeps the bounds right; [`cpu`] writes the vertices.

mod cpu;
mod topology;

use std::{
    collections::HashMap,
    sync::{Arc, Weak},
    time::Instant,
};

use bevy::{
    asset::RenderAssetUsages,
    camera::{
        primitives::Aabb,
        visibility::{NoAutoAabb, VisibilitySystems},
    },
    diagnostic::Diagnostics,
    mesh::{Indices, PrimitiveTopology},
    prelude::*,
};
use pliant_modal::{ModalModel, ModelHash};

use crate::{BodyState, DEFORM_TIME, ModalBody, PliantDisplaySystems, ShownState};
use topology::Topology;

/// How a body's surface is shaded. Every [`ModalBody`] has one.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct SurfaceShading {
    /// Edges of the rest shape that bend by more than this angle (rad) are drawn sharp, all others smooth. Pi or more smooths
    /// everything. Default: `0.9` (52 degrees: the edges of a box stay edges).
    pub crease: f32,
}

impl Default for SurfaceShading {
    fn default() -> Self {
        Self { crease: 0.9 }
    }
}

/// What drawing a model needs besides its modes; shared by the bodies that look alike.
#[derive(Debug)]
struct Drawing {
    topology: Topology,
    /// For each mode the farthest that a unit of its coordinate moves any vertex, kg^-1/2: `|u| <= sum |q_k| reach_k`, warped or not,
    /// as no singular value of `R~` exceeds one.
    reach: Vec<f32>,
    rest: Aabb,
}

impl Drawing {
    fn new(model: &ModalModel, crease: f32) -> Self {
        let vertices = model.surface().positions().len();
        let reach = model
            .parts()
            .displacement
            .chunks_exact(3 * vertices)
            .map(|mode| {
                mode.chunks_exact(3)
                    .map(|u| u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
                    .fold(0.0, f32::max)
                    .sqrt()
            })
            .collect();
        let [low, high] = model.surface().bounds();
        Self {
            topology: Topology::new(model.surface(), crease),
            reach,
            rest: Aabb::from_min_max(low.into(), high.into()),
        }
    }

    /// Bounds that hold the surface whatever its shape at `q`, at the cost of one number a mode.
    fn bounds(&self, q: &[f64]) -> Aabb {
        let reach: f64 = q.iter().zip(&self.reach).map(|(q, &reach)| q.abs() * f64::from(reach)).sum();
        Aabb { center: self.rest.center, half_extents: self.rest.half_extents + reach as f32 }
    }
}

/// The drawings in use, by model and crease angle.
#[derive(Resource, Default)]
struct Drawings(HashMap<(ModelHash, u32), Weak<Drawing>>);

impl Drawings {
    fn get(&mut self, model: &ModalModel, crease: f32) -> Arc<Drawing> {
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

/// Marks a body whose surface is on screen, and remembers which state of it.
#[derive(Component, Debug)]
pub struct DrawnSurface {
    model: Arc<ModalModel>,
    drawing: Arc<Drawing>,
    crease: f32,
    version: u64,
}

pub(crate) fn build(app: &mut App) {
    app.register_type::<SurfaceShading>()
        .register_required_components::<ModalBody, SurfaceShading>()
        .init_resource::<Drawings>()
        .add_systems(
            PostUpdate,
            (make_meshes, deform_surfaces)
                .chain()
                // A server is built with this feature when its neighbour in the workspace draws: it has no meshes.
                .run_if(resource_exists::<Assets<Mesh>>)
                .in_set(PliantDisplaySystems::Deform)
                // It asks who was seen in the frame before; from here on visibility is found anew.
                .before(VisibilitySystems::VisibilityPropagate)
                .before(VisibilitySystems::CalculateBounds),
        );
}

fn make_meshes(
    mut commands: Commands,
    mut drawings: ResMut<Drawings>,
    mut meshes: ResMut<Assets<Mesh>>,
    bodies: Query<(Entity, &BodyState, &ShownState, &SurfaceShading, Option<&DrawnSurface>)>,
) {
    for (entity, state, shown, shading, drawn) in &bodies {
        let model = state.model();
        if drawn.is_some_and(|drawn| Arc::ptr_eq(&drawn.model, model) && drawn.crease == shading.crease) {
            continue;
        }
        let drawing = drawings.get(model, shading.crease);
        let mut scratch = cpu::Scratch::default();
        let mut mesh = new_mesh(model, &drawing.topology);
        let bounds = cpu::write(model, &drawing.topology, shown.q(), state.warps(), &mut mesh, &mut scratch);
        commands.entity(entity).insert((
            Mesh3d(meshes.add(mesh)),
            DrawnSurface { model: model.clone(), drawing, crease: shading.crease, version: shown.version() },
            bounds.unwrap_or_default(),
            NoAutoAabb,
        ));
    }
}

fn new_mesh(model: &ModalModel, topology: &Topology) -> Mesh {
    let surface = model.surface();
    let pick = |from: &[[f32; 3]]| topology.source.iter().map(|&v| from[v as usize]).collect::<Vec<_>>();
    let mesh = Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
        .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, pick(surface.positions()))
        .with_inserted_attribute(Mesh::ATTRIBUTE_NORMAL, vec![[0.0, 1.0, 0.0]; topology.source.len()])
        .with_inserted_indices(Indices::U32(topology.triangles.iter().flatten().copied().collect()));
    match surface.uvs() {
        Some(uvs) => {
            let uvs: Vec<[f32; 2]> = topology.source.iter().map(|&v| uvs[v as usize]).collect();
            mesh.with_inserted_attribute(Mesh::ATTRIBUTE_UV_0, uvs)
        }
        None => mesh,
    }
}

fn deform_surfaces(
    mut meshes: ResMut<Assets<Mesh>>,
    mut diagnostics: Diagnostics,
    mut scratch: Local<cpu::Scratch>,
    mut bodies: Query<(
        &BodyState,
        &ShownState,
        &Mesh3d,
        &mut DrawnSurface,
        &mut Aabb,
        &InheritedVisibility,
        &ViewVisibility,
    )>,
) {
    let start = Instant::now();
    let mut written = false;
    for (state, shown, mesh, mut drawn, mut aabb, inherited, view) in &mut bodies {
        if drawn.version == shown.version() || !inherited.get() || !Arc::ptr_eq(&drawn.model, state.model()) {
            continue;
        }
        if !view.get() {
            // Out of every view: only the bounds follow, so that it is seen when it comes back in.
            aabb.set_if_neq(drawn.drawing.bounds(shown.q()));
            continue;
        }
        let Some(mut mesh) = meshes.get_mut(&mesh.0) else { continue };
        let bounds = cpu::write(
            &drawn.model,
            &drawn.drawing.topology,
            shown.q(),
            state.warps(),
            &mut mesh,
            &mut scratch,
        );
        if let Some(bounds) = bounds {
            aabb.set_if_neq(bounds);
        }
        drawn.version = shown.version();
        written = true;
    }
    if written {
        diagnostics.add_measurement(&DEFORM_TIME, || start.elapsed().as_secs_f64() * 1e3);
    }
}

//! The deformed surface on screen: one [`Mesh`] per body, updated when its visible shape changes.
//!
//! The mesh is an ordinary mesh, so that every material, shadow pass and prepass works with it.
//! This module selects the surfaces to update and their level of detail ([`detail`]), and maintains
//! the bounds. [`gpu`] writes the vertices into the vertex buffer. [`cpu`] writes them where no
//! suitable GPU is available.

mod cpu;
mod detail;
mod drawing;
mod gpu;
mod parts;
mod topology;

use std::{ops::Range, sync::Arc};

use bevy::{
    asset::{AssetEventSystems, RenderAssetUsages},
    camera::{
        primitives::Aabb,
        visibility::{NoAutoAabb, VisibilitySystems},
    },
    diagnostic::Diagnostics,
    ecs::system::NonSendMarker,
    mesh::{Indices, PrimitiveTopology},
    platform::time::Instant,
    prelude::*,
    utils::Parallel,
};
use pliant_modal::{HeldShapes, ModalModel};

use crate::{BodyState, DEFORM_TIME, ModalBody, PliantDisplaySystems, VisualState, step::batches};
use detail::{Detail, Views};
use drawing::{Drawing, Drawings};
use gpu::{Compute, GpuShape};
use topology::Topology;

pub use detail::SurfaceDetail;
pub use parts::SurfacePart;

/// The shading of a body's surface. Every [`ModalBody`] has one.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct SurfaceShading {
    /// Edges of the rest shape that bend by more than this angle are drawn sharp, all others
    /// smooth, rad. Pi or more smooths everything. Default: `0.9` (52 degrees, which keeps the
    /// edges of a box sharp).
    pub crease: f32,
}

impl Default for SurfaceShading {
    fn default() -> Self {
        Self { crease: 0.9 }
    }
}

/// Selects whether the GPU or the CPU writes the deformed surfaces. May be changed at any time.
#[derive(Resource, Reflect, Debug, Clone, Copy, Default, PartialEq, Eq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub enum SurfaceDeformation {
    /// Uses a compute shader if the renderer has a GPU, and the CPU otherwise. The CPU is used
    /// without a renderer, without compute shaders, with a software renderer, and for a model that
    /// does not fit into the GPU's bindings.
    #[default]
    Auto,
    /// Always uses the CPU. The [`Mesh`] asset then holds the deformed shape for other readers.
    Processor,
    /// Uses a compute shader wherever there is one, including a software renderer. The [`Mesh`]
    /// asset keeps the shape with which it was made.
    Compute,
}

/// Marks a body whose surface is drawn, and stores which state is drawn.
#[derive(Component, Debug)]
pub struct DrawnSurface {
    model: Arc<ModalModel>,
    drawing: Arc<Drawing>,
    /// The mesh that was made for this body.
    mesh: AssetId<Mesh>,
    crease: f32,
    version: u64,
    detail: Detail,
    /// Whether the compute shader wrote the surface.
    computed: bool,
}

pub(crate) fn build(app: &mut App) {
    app.register_type::<SurfaceShading>()
        .register_type::<SurfaceDetail>()
        .register_type::<SurfacePart>()
        .register_type::<SurfaceDeformation>()
        .register_required_components::<ModalBody, SurfaceShading>()
        .register_required_components::<ModalBody, SurfaceDetail>()
        .init_resource::<Drawings>()
        .init_resource::<SurfaceDeformation>()
        .add_observer(take_down)
        .add_systems(PreStartup, gpu::find)
        .add_systems(
            PostUpdate,
            (
                (make_meshes, deform_surfaces, parts::draw_parts)
                    .chain()
                    .in_set(PliantDisplaySystems::Deform)
                    // These systems read the visibility of the frame before. Bevy computes the
                    // visibility of this frame after them.
                    .before(VisibilitySystems::VisibilityPropagate)
                    .before(VisibilitySystems::CalculateBounds),
                write_again.after(AssetEventSystems).run_if(resource_exists::<Compute>),
            )
                // Another crate of the workspace that draws can enable this feature for a headless
                // server, which has no mesh assets.
                .run_if(resource_exists::<Assets<Mesh>>),
        );
}

pub(crate) fn finish(app: &mut App) {
    gpu::finish(app);
}

fn make_meshes(
    mut commands: Commands,
    mut drawings: ResMut<Drawings>,
    mut meshes: ResMut<Assets<Mesh>>,
    bodies: Query<(Entity, &BodyState, &VisualState, &SurfaceShading, Option<&DrawnSurface>)>,
) {
    for (entity, state, visual, shading, drawn) in &bodies {
        let model = state.model();
        // The comparison uses bits, so that a NaN angle equals the same NaN in the next frame.
        let same = |drawn: &DrawnSurface| {
            Arc::ptr_eq(&drawn.model, model) && drawn.crease.to_bits() == shading.crease.to_bits()
        };
        if drawn.is_some_and(same) {
            continue;
        }
        let drawing = drawings.get(model, shading.crease);
        let mut scratch = cpu::Scratch::default();
        let mut mesh = new_mesh(model, &drawing.topology);
        let detail = Detail { modes: visual.q().len(), warped: state.warps() };
        let mut q = Vec::new();
        visual.draw(&mut q);
        let shape = cpu::Shape { q: &q, warped: state.warps(), held: held(visual) };
        let topology = &drawing.topology;
        let bounds = cpu::Vertices::take(&mut mesh, topology).map(|mut vertices| {
            let bounds = vertices.write(model, state.precision(), topology, &shape, &mut scratch);
            vertices.give(&mut mesh);
            bounds
        });
        let mesh = meshes.add(mesh);
        // The entity may have been despawned in this frame.
        commands
            .entity(entity)
            .try_insert((
                Mesh3d(mesh.clone()),
                DrawnSurface {
                    mesh: mesh.id(),
                    model: model.clone(),
                    drawing,
                    crease: shading.crease,
                    version: visual.version(),
                    detail,
                    computed: false,
                },
                bounds.unwrap_or_default(),
                NoAutoAabb,
            ))
            .try_remove::<GpuShape>();
    }
}

/// Removes the drawing of an entity whose [`ModalBody`] was removed. A mesh that was set from
/// outside stays.
fn take_down(
    removed: On<Remove, ModalBody>,
    mut commands: Commands,
    drawn: Query<(&DrawnSurface, Option<&Mesh3d>)>,
) {
    let Ok((drawn, mesh)) = drawn.get(removed.entity) else { return };
    let mut entity = commands.entity(removed.entity);
    entity.try_remove::<(DrawnSurface, GpuShape)>();
    if mesh.is_some_and(|mesh| mesh.id() == drawn.mesh) {
        entity.try_remove::<(Mesh3d, Aabb, NoAutoAabb)>();
    }
}

/// The own shapes of held patches in the shown state, with their coordinates.
fn held(visual: &VisualState) -> Option<(&HeldShapes, &[f64])> {
    visual.held().map(|(shapes, s)| (&**shapes, s))
}

/// Writes the displacements by held patches' own shapes. Returns the longest, m.
fn write_moved(visual: &VisualState, out: &mut Vec<[f32; 4]>) -> f32 {
    out.clear();
    let mut longest = 0.0f32;
    if let Some((shapes, s)) = held(visual) {
        out.extend(shapes.vertices().iter().zip(shapes.displacements(s)).map(|(&vertex, [x, y, z])| {
            longest = longest.max(Vec3::new(x, y, z).length());
            // The numbers of a surface's vertices are exact in single precision.
            [vertex as f32, x, y, z]
        }));
    }
    longest
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
            let tangents = vec![[1.0, 0.0, 0.0, 1.0]; uvs.len()];
            mesh.with_inserted_attribute(Mesh::ATTRIBUTE_UV_0, uvs)
                .with_inserted_attribute(Mesh::ATTRIBUTE_TANGENT, tangents)
        }
        None => mesh,
    }
}

/// Buffers that are reused for all bodies and frames.
#[derive(Default)]
struct DeformScratch {
    /// One for each thread.
    cpu: Parallel<cpu::Scratch>,
    q: Vec<f64>,
    moved: Vec<[f32; 4]>,
    /// Coordinates of the surfaces that the CPU writes.
    kept: Vec<f64>,
}

/// A surface that the CPU writes in this frame.
struct Written<'a> {
    state: &'a BodyState,
    visual: &'a VisualState,
    mesh: AssetId<Mesh>,
    drawn: Mut<'a, DrawnSurface>,
    aabb: Mut<'a, Aabb>,
    /// Where its coordinates are.
    kept: Range<usize>,
    warped: bool,
    vertices: cpu::Vertices,
    bounds: Aabb,
}

/// Vertices that are worth handing out to another thread.
const WORTH: usize = 2_000;

fn deform_surfaces(
    // As for steps: the main thread works too.
    _main: NonSendMarker,
    mut commands: Commands,
    wanted: Res<SurfaceDeformation>,
    compute: Option<Res<Compute>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut diagnostics: Diagnostics,
    mut scratch: Local<DeformScratch>,
    cameras: Query<(&Camera, &GlobalTransform)>,
    mut bodies: Query<(
        Entity,
        &BodyState,
        &VisualState,
        &SurfaceDetail,
        &GlobalTransform,
        &Mesh3d,
        &mut DrawnSurface,
        Option<&mut GpuShape>,
        &mut Aabb,
        &InheritedVisibility,
        &ViewVisibility,
    )>,
) {
    let start = Instant::now();
    let mut written = false;
    let mut by_cpu: Vec<Written<'_>> = Vec::new();
    let DeformScratch { cpu: scratch, q, moved: moved_by_hands, kept: coordinates } = &mut *scratch;
    coordinates.clear();
    let views = Views::new(cameras.iter());
    for (entity, state, visual, allowed, place, mesh, mut drawn, shape, mut aabb, inherited, view) in
        &mut bodies
    {
        if !inherited.get() || !Arc::ptr_eq(&drawn.model, state.model()) {
            continue;
        }
        let compute = match (*wanted, &compute) {
            (SurfaceDeformation::Auto, Some(compute)) => !compute.software && compute.takes(&drawn.drawing),
            (SurfaceDeformation::Compute, Some(compute)) => compute.takes(&drawn.drawing),
            _ => false,
        };
        let moved = drawn.version != visual.version() || compute != drawn.computed;
        let full = Detail { modes: visual.q().len(), warped: state.warps() };
        if !moved && drawn.detail.covers(full) {
            continue;
        }
        visual.draw(q);
        let longest = write_moved(visual, moved_by_hands);
        let bounds = || {
            let Aabb { center, half_extents } = drawn.drawing.bounds(q);
            Aabb { center, half_extents: half_extents + longest }
        };
        if !view.get() {
            // The body is in no view. Only its bounds are updated, so that the body is found when
            // it comes back into a view.
            aabb.set_if_neq(bounds());
            continue;
        }
        let detail = match views.meters_per_pixel(&aabb, place) {
            Some(meters) => {
                let error = f64::from(meters * allowed.tolerance.max(0.0)) / state.scale();
                Detail::needed(&drawn.drawing, q, full.warped, error)
            }
            // No camera sees the body, only a light, or this is a test.
            None => full,
        };
        if !moved && drawn.detail.covers(detail) {
            continue;
        }
        let kept = &q[..detail.modes];
        if compute {
            aabb.set_if_neq(bounds());
            match shape {
                Some(mut shape) => {
                    shape.q.clear();
                    shape.q.extend(kept.iter().map(|&q| q as f32));
                    shape.warped = detail.warped;
                    shape.moved.clone_from(moved_by_hands);
                    shape.mesh = mesh.id();
                }
                None => {
                    commands.entity(entity).try_insert(GpuShape {
                        drawing: drawn.drawing.clone(),
                        mesh: mesh.id(),
                        q: kept.iter().map(|&q| q as f32).collect(),
                        warped: detail.warped,
                        moved: moved_by_hands.clone(),
                    });
                }
            }
        } else {
            if shape.is_some() {
                commands.entity(entity).try_remove::<GpuShape>();
            }
            let Some(mut asset) = meshes.get_mut(&mesh.0) else { continue };
            (drawn.version, drawn.detail, drawn.computed) = (visual.version(), detail, false);
            let Some(vertices) = cpu::Vertices::take(&mut asset, &drawn.drawing.topology) else { continue };
            let begin = coordinates.len();
            coordinates.extend_from_slice(kept);
            by_cpu.push(Written {
                state,
                visual,
                mesh: mesh.id(),
                drawn,
                aabb,
                kept: begin..coordinates.len(),
                warped: detail.warped,
                vertices,
                bounds: Aabb::default(),
            });
            continue;
        }
        (drawn.version, drawn.detail, drawn.computed) = (visual.version(), detail, true);
        written = true;
    }
    written |= !by_cpu.is_empty();
    let work: usize = by_cpu.iter().map(|surface| surface.drawn.drawing.topology.source.len()).sum();
    batches(&mut by_cpu, work >= WORTH, |part| {
        let mut scratch = scratch.borrow_local_mut();
        for Written { state, visual, drawn, kept, warped, vertices, bounds, .. } in part {
            let shape = cpu::Shape { q: &coordinates[kept.clone()], warped: *warped, held: held(visual) };
            let topology = &drawn.drawing.topology;
            *bounds = vertices.write(&drawn.model, state.precision(), topology, &shape, &mut scratch);
        }
    });
    for mut surface in by_cpu {
        surface.aabb.set_if_neq(surface.bounds);
        // Its change was noted when the vertices were taken.
        if let Some(mesh) = meshes.get_mut_untracked(surface.mesh) {
            surface.vertices.give(mesh);
        }
    }
    if written {
        diagnostics.add_measurement(&DEFORM_TIME, || start.elapsed().as_secs_f64() * 1e3);
    }
}

/// Writes the surface again after its mesh was changed from outside, for example by adding vertex
/// colors. Bevy uploads a changed mesh with the shape of the asset, so the compute pass must
/// overwrite it.
fn write_again(mut events: MessageReader<AssetEvent<Mesh>>, mut shapes: Query<&mut GpuShape>) {
    let modified: Vec<AssetId<Mesh>> = events
        .read()
        .filter_map(|event| match event {
            AssetEvent::Modified { id } => Some(*id),
            _ => None,
        })
        .collect();
    if modified.is_empty() {
        return;
    }
    for mut shape in &mut shapes {
        if modified.contains(&shape.mesh) {
            shape.set_changed();
        }
    }
}

//! The compute pass, which writes the deformed surface into the vertex buffer of the drawn mesh.
//!
//! The main world passes only modal coordinates, as one [`GpuShape`] per body, when the picture
//! must change. The basis is on the GPU once per model. Bodies that share a model and a buffer use
//! one dispatch. Every material, shadow pass and prepass reads the usual vertex buffer.

use std::{
    collections::HashMap,
    sync::{Arc, Weak},
};

use bevy::{
    asset::{AssetId, embedded_asset, load_embedded_asset},
    core_pipeline::schedule::camera_driver,
    ecs::entity::EntityHashMap,
    prelude::*,
    render::{
        Extract, ExtractSchedule, GpuResourceAppExt, Render, RenderApp, RenderStartup, RenderSystems,
        diagnostic::RecordDiagnostics,
        mesh::{
            RenderMesh,
            allocator::{MeshAllocator, MeshAllocatorSettings},
        },
        render_asset::RenderAssets,
        render_resource::{
            BindGroup, BindGroupEntries, BindGroupLayoutDescriptor, BindGroupLayoutEntries, Buffer,
            BufferBinding, BufferDescriptor, BufferId, BufferInitDescriptor, BufferUsages, BufferVec,
            CachedComputePipelineId, ComputePassDescriptor, ComputePipelineDescriptor, DownlevelFlags,
            DynamicUniformBuffer, PipelineCache, RawBufferVec, ShaderStages, ShaderType,
            binding_types::{storage_buffer_read_only_sized, storage_buffer_sized, uniform_buffer},
        },
        renderer::{RenderAdapter, RenderAdapterInfo, RenderContext, RenderDevice, RenderGraph, RenderQueue},
        settings::WgpuLimits,
    },
};

use super::{drawing::Drawing, topology::Tangent};

/// Maximum size of the scratch positions of one dispatch, bytes. Bodies beyond it need further
/// dispatches.
const SCRATCH_BYTES: u64 = 64 << 20;

/// Threads per workgroup in the shader.
const WORKGROUP: u32 = 64;

/// The shape that the vertex buffer of a body must hold.
#[derive(Component, Clone)]
pub(super) struct GpuShape {
    pub drawing: Arc<Drawing>,
    pub mesh: AssetId<Mesh>,
    pub q: Vec<f32>,
    pub warped: bool,
    /// Displacements besides those of the coordinates, m, with the number of the vertex before
    /// them. The numbers ascend.
    pub moved: Vec<[f32; 4]>,
}

/// The limits of the compute device. This resource is in the main world and only exists if the
/// device can run the compute pass.
#[derive(Resource)]
pub(super) struct Compute {
    limits: WgpuLimits,
    /// Whether the device is a software renderer on the CPU.
    pub software: bool,
}

impl Compute {
    /// Whether all data of a model fits into the bindings of this device.
    pub fn takes(&self, drawing: &Drawing) -> bool {
        let basis = drawing.model.basis();
        let Some(rows) = basis.rows() else { return false };
        let largest = self.limits.max_storage_buffer_binding_size;
        let vertices = basis.vertices().max(drawing.topology.source.len()) as u64;
        let buffer = largest.min(self.limits.max_buffer_size);
        size_of_val(rows) as u64 <= buffer
            && 4 * drawing.topology.words() as u64 <= buffer
            // Twelve floats per vertex are more than any mesh of this plugin has.
            && vertices * 48 <= largest
            && vertices.div_ceil(u64::from(WORKGROUP)) <= u64::from(self.limits.max_compute_workgroups_per_dimension)
    }
}

/// Inspects the renderer's device, in the first frame.
pub(super) fn find(
    mut commands: Commands,
    device: Option<Res<RenderDevice>>,
    adapter: Option<Res<RenderAdapter>>,
    info: Option<Res<RenderAdapterInfo>>,
) {
    let (Some(device), Some(adapter)) = (device, adapter) else { return };
    let limits = device.limits();
    let computes = adapter.get_downlevel_capabilities().flags.contains(DownlevelFlags::COMPUTE_SHADERS)
        && limits.max_storage_buffers_per_shader_stage >= 7
        && limits.max_compute_invocations_per_workgroup >= WORKGROUP;
    if computes {
        let software = info.is_some_and(|info| info.device_type == wgpu_types::DeviceType::Cpu);
        commands.insert_resource(Compute { limits, software });
    }
}

/// Adds the compute pass to the render world, if there is one.
pub(super) fn finish(app: &mut App) {
    if app.get_sub_app(RenderApp).is_none() {
        return;
    }
    embedded_asset!(app, "deform.wgsl");
    let Some(render) = app.get_sub_app_mut(RenderApp) else { return };
    render
        .world_mut()
        .get_resource_or_init::<MeshAllocatorSettings>()
        .extra_buffer_usages
        .insert(BufferUsages::STORAGE);
    render
        .init_resource::<Shapes>()
        .init_gpu_resource::<Device>()
        .add_systems(RenderStartup, queue_pipelines)
        .add_systems(ExtractSchedule, extract)
        .add_systems(Render, prepare.in_set(RenderSystems::PrepareResources))
        .add_systems(RenderGraph, dispatch.before(camera_driver));
}

/// The newest shape of every body, and whether its vertex buffer holds that shape. This resource is
/// in the render world.
#[derive(Resource, Default)]
struct Shapes(EntityHashMap<ResidentShape>);

struct ResidentShape {
    wanted: GpuShape,
    /// The buffer and the vertex offset to which `wanted` was written.
    written: Option<(BufferId, u32)>,
}

fn extract(
    mut shapes: ResMut<Shapes>,
    changed: Extract<Query<(Entity, &GpuShape), Changed<GpuShape>>>,
    mut removed: Extract<RemovedComponents<GpuShape>>,
    all: Extract<Query<(), With<GpuShape>>>,
) {
    for entity in removed.read() {
        if !all.contains(entity) {
            shapes.0.remove(&entity);
        }
    }
    for (entity, shape) in &changed {
        match shapes.0.get_mut(&entity) {
            Some(kept) => {
                kept.wanted.clone_from(shape);
                kept.written = None;
            }
            None => {
                shapes.0.insert(entity, ResidentShape { wanted: shape.clone(), written: None });
            }
        }
    }
}

/// The struct `Surface` of `deform.wgsl`.
#[derive(ShaderType, Clone, Copy)]
struct GpuSurface {
    vertices: u32,
    drawn: u32,
    modes: u32,
    starts: u32,
    corners: u32,
    first: u32,
    tangents: u32,
    pad: u32,
}

/// The struct `Job` of `deform.wgsl`.
#[derive(ShaderType, Clone, Copy)]
struct DeformJob {
    q: u32,
    modes: u32,
    warped: u32,
    positions: u32,
    start: u32,
    stride: u32,
    position: u32,
    normal: u32,
    tangent: u32,
    moved: u32,
    moved_count: u32,
}

/// The GPU data of a model.
struct Resident {
    of: Weak<Drawing>,
    rest: Buffer,
    basis: Buffer,
    topology: Buffer,
    /// The surface data, in which `first` is filled in per dispatch.
    surface: GpuSurface,
}

impl Resident {
    fn new(device: &RenderDevice, drawing: &Arc<Drawing>) -> Option<Self> {
        let buffer = |label: &str, contents: &[u8]| {
            device.create_buffer_with_data(&BufferInitDescriptor {
                label: Some(label),
                // An empty buffer cannot be bound.
                contents: if contents.is_empty() { &[0; 4] } else { contents },
                usage: BufferUsages::STORAGE,
            })
        };
        let basis = drawing.model.basis();
        let topology = &drawing.topology;
        let (starts, corners) = topology.corners();
        let mut words: Vec<u32> = Vec::with_capacity(topology.words());
        words.extend(
            topology.source.iter().zip(&topology.normal).flat_map(|(&source, &normal)| [source, normal]),
        );
        let starts_at = words.len() as u32;
        words.extend(&starts);
        let corners_at = words.len() as u32;
        words.extend(corners.iter().flatten());
        let tangents_at = if topology.tangents.is_empty() { 0 } else { words.len() as u32 };
        for Tangent { triangle, edges, sign } in &topology.tangents {
            words.extend(triangle);
            words.extend([edges[0], edges[1], *sign].map(f32::to_bits));
        }
        Some(Self {
            of: Arc::downgrade(drawing),
            rest: buffer("pliant rest", bytemuck::cast_slice(drawing.model.surface().positions())),
            basis: buffer("pliant basis", bytemuck::cast_slice(basis.rows()?)),
            topology: buffer("pliant topology", bytemuck::cast_slice(&words)),
            surface: GpuSurface {
                vertices: basis.vertices() as u32,
                drawn: topology.source.len() as u32,
                modes: basis.modes() as u32,
                starts: starts_at,
                corners: corners_at,
                first: 0,
                tangents: tangents_at,
                pad: 0,
            },
        })
    }
}

/// All data that is lost with the GPU device and made again with the next device.
#[derive(Resource)]
struct Device {
    residents: HashMap<usize, Resident>,
    surfaces: DynamicUniformBuffer<GpuSurface>,
    jobs: BufferVec<DeformJob>,
    coordinates: RawBufferVec<f32>,
    scratch: Option<Buffer>,
    dispatches: Vec<Dispatch>,
}

impl FromWorld for Device {
    fn from_world(world: &mut World) -> Self {
        // The buffers of a lost device hold nothing.
        for shape in world.resource_mut::<Shapes>().0.values_mut() {
            shape.written = None;
        }
        let mut coordinates = RawBufferVec::new(BufferUsages::STORAGE);
        coordinates.set_label(Some("pliant modal coordinates"));
        Self {
            residents: HashMap::new(),
            surfaces: DynamicUniformBuffer::default(),
            jobs: BufferVec::new(BufferUsages::STORAGE),
            coordinates,
            scratch: None,
            dispatches: Vec::new(),
        }
    }
}

struct Dispatch {
    group: BindGroup,
    surface: u32,
    vertices: u32,
    drawn: u32,
    bodies: u32,
}

#[derive(Resource)]
struct Pipelines {
    layout: BindGroupLayoutDescriptor,
    positions: CachedComputePipelineId,
    mesh: CachedComputePipelineId,
}

fn queue_pipelines(mut commands: Commands, assets: Res<AssetServer>, cache: Res<PipelineCache>) {
    let read = || storage_buffer_read_only_sized(false, None);
    let layout = BindGroupLayoutDescriptor::new(
        "pliant_deform",
        &BindGroupLayoutEntries::sequential(
            ShaderStages::COMPUTE,
            (
                uniform_buffer::<GpuSurface>(true),
                read(),
                read(),
                read(),
                read(),
                read(),
                storage_buffer_sized(false, None),
                storage_buffer_sized(false, None),
            ),
        ),
    );
    let shader = load_embedded_asset!(assets.as_ref(), "deform.wgsl");
    let queue = |entry: &'static str| {
        cache.queue_compute_pipeline(ComputePipelineDescriptor {
            label: Some(format!("pliant {entry}").into()),
            layout: vec![layout.clone()],
            shader: shader.clone(),
            entry_point: Some(entry.into()),
            ..default()
        })
    };
    let (positions, mesh) = (queue("write_positions"), queue("write_mesh"));
    commands.insert_resource(Pipelines { layout, positions, mesh });
}

/// The location of a mesh's vertices, in bytes and in words.
struct BufferSlot {
    buffer: Buffer,
    first: u32,
    bytes: std::ops::Range<u64>,
    stride: u32,
    position: u32,
    normal: u32,
    tangent: Option<u32>,
}

fn place(
    mesh: AssetId<Mesh>,
    drawn: usize,
    meshes: &RenderAssets<RenderMesh>,
    allocator: &MeshAllocator,
) -> Option<BufferSlot> {
    let layout = &meshes.get(mesh)?.layout.0;
    let slice = allocator.mesh_vertex_slice(&mesh)?;
    // A mesh that was replaced from outside is left alone.
    if slice.range.len() != drawn {
        return None;
    }
    let stride = layout.layout().array_stride;
    let offset = |attribute: bevy::mesh::MeshVertexAttribute| {
        let index = layout.attribute_ids().iter().position(|id| *id == attribute.id)?;
        let attribute = layout.layout().attributes.get(index)?;
        (attribute.offset % 4 == 0).then_some((attribute.offset / 4) as u32)
    };
    Some(BufferSlot {
        buffer: slice.buffer.clone(),
        first: slice.range.start,
        bytes: u64::from(slice.range.start) * stride..u64::from(slice.range.end) * stride,
        stride: (stride % 4 == 0).then_some((stride / 4) as u32)?,
        position: offset(Mesh::ATTRIBUTE_POSITION)?,
        normal: offset(Mesh::ATTRIBUTE_NORMAL)?,
        tangent: offset(Mesh::ATTRIBUTE_TANGENT),
    })
}

fn prepare(
    mut shapes: ResMut<Shapes>,
    device: ResMut<Device>,
    pipelines: Res<Pipelines>,
    cache: Res<PipelineCache>,
    meshes: Res<RenderAssets<RenderMesh>>,
    allocator: Res<MeshAllocator>,
    render_device: Res<RenderDevice>,
    queue: Res<RenderQueue>,
) {
    let device = device.into_inner();
    device.dispatches.clear();
    // This runs in every frame, so that the memory of a model without drawn bodies is freed even if
    // nothing moves.
    device.residents.retain(|_, resident| resident.of.strong_count() > 0);
    if cache.get_compute_pipeline(pipelines.positions).is_none()
        || cache.get_compute_pipeline(pipelines.mesh).is_none()
    {
        return;
    }
    // The work consists of the shapes to write and their locations. Bodies of one model in one
    // buffer are adjacent, sorted by their location in the buffer.
    let mut work: Vec<(usize, BufferSlot, &mut ResidentShape)> = shapes
        .0
        .values_mut()
        .filter_map(|shape| {
            let drawn = shape.wanted.drawing.topology.source.len();
            let place = place(shape.wanted.mesh, drawn, &meshes, &allocator)?;
            let here = (place.buffer.id(), place.first);
            (shape.written != Some(here)).then_some((
                Arc::as_ptr(&shape.wanted.drawing) as usize,
                place,
                shape,
            ))
        })
        .collect();
    if work.is_empty() {
        return;
    }
    work.sort_by_key(|(drawing, place, _)| (*drawing, place.buffer.id(), place.first));

    device.surfaces.clear();
    device.jobs.clear();
    device.coordinates.clear();
    let limits = render_device.limits();
    let alignment = u64::from(limits.min_storage_buffer_offset_alignment).max(4);
    let largest = limits.max_storage_buffer_binding_size;
    let most_bodies = u64::from(limits.max_compute_workgroups_per_dimension);

    /// Bodies of one dispatch: their model, the offset of their surface data, their number, and
    /// their byte range in the vertex buffer.
    struct Batch {
        drawing: usize,
        surface: u32,
        buffer: Buffer,
        bytes: std::ops::Range<u64>,
        bodies: u64,
    }
    let mut batches: Vec<Batch> = Vec::new();
    let mut scratch_needed = 4;
    for (key, place, shape) in &mut work {
        let drawing = &shape.wanted.drawing;
        if !device.residents.contains_key(key) {
            let Some(resident) = Resident::new(&render_device, drawing) else { continue };
            device.residents.insert(*key, resident);
        }
        let Some(resident) = device.residents.get(key) else { continue };
        let scratch = u64::from(resident.surface.vertices) * 12;
        let low = place.bytes.start / alignment * alignment;
        let joins = batches.last().is_some_and(|batch| {
            batch.drawing == *key
                && batch.buffer.id() == place.buffer.id()
                && place.bytes.end - batch.bytes.start <= largest
                && (batch.bodies + 1) * scratch <= SCRATCH_BYTES.min(largest)
                && batch.bodies < most_bodies
        });
        if !joins {
            let first = device.jobs.len() as u32;
            batches.push(Batch {
                drawing: *key,
                surface: device.surfaces.push(&GpuSurface { first, ..resident.surface }),
                buffer: place.buffer.clone(),
                bytes: low..low,
                bodies: 0,
            });
        }
        let Some(batch) = batches.last_mut() else { continue };
        device.jobs.push(DeformJob {
            q: device.coordinates.len() as u32,
            modes: (shape.wanted.q.len() as u32).min(resident.surface.modes),
            warped: u32::from(shape.wanted.warped),
            positions: (batch.bodies * u64::from(resident.surface.vertices) * 3) as u32,
            start: ((place.bytes.start - batch.bytes.start) / 4) as u32,
            stride: place.stride,
            position: place.position,
            normal: place.normal,
            tangent: place.tangent.unwrap_or(u32::MAX),
            moved: (device.coordinates.len() + shape.wanted.q.len()) as u32,
            moved_count: shape.wanted.moved.len() as u32,
        });
        device.coordinates.extend(shape.wanted.q.iter().copied());
        device.coordinates.extend(shape.wanted.moved.as_flattened().iter().copied());
        batch.bodies += 1;
        batch.bytes.end = place.bytes.end;
        scratch_needed = scratch_needed.max(batch.bodies * scratch);
        shape.written = Some((place.buffer.id(), place.first));
    }
    // A body that is drawn with no modes still needs a buffer to bind.
    device.coordinates.push(0.0);
    if device.scratch.as_ref().is_none_or(|buffer| buffer.size() < scratch_needed) {
        device.scratch = Some(render_device.create_buffer(&BufferDescriptor {
            label: Some("pliant scratch positions"),
            size: scratch_needed.next_power_of_two().min(largest).max(scratch_needed),
            usage: BufferUsages::STORAGE,
            mapped_at_creation: false,
        }));
    }
    device.surfaces.write_buffer(&render_device, &queue);
    device.jobs.write_buffer(&render_device, &queue);
    device.coordinates.write_buffer(&render_device, &queue);

    let (Some(surfaces), Some(jobs), Some(coordinates), Some(scratch)) = (
        device.surfaces.binding(),
        device.jobs.buffer(),
        device.coordinates.buffer(),
        device.scratch.as_ref(),
    ) else {
        return;
    };
    let layout = cache.get_bind_group_layout(&pipelines.layout);
    for batch in batches {
        let Some(resident) = device.residents.get(&batch.drawing) else { continue };
        let group = render_device.create_bind_group(
            "pliant_deform",
            &layout,
            &BindGroupEntries::sequential((
                surfaces.clone(),
                resident.rest.as_entire_binding(),
                resident.basis.as_entire_binding(),
                resident.topology.as_entire_binding(),
                jobs.as_entire_binding(),
                coordinates.as_entire_binding(),
                scratch.as_entire_binding(),
                BufferBinding {
                    buffer: &batch.buffer,
                    offset: batch.bytes.start,
                    size: std::num::NonZeroU64::new(batch.bytes.end - batch.bytes.start),
                },
            )),
        );
        device.dispatches.push(Dispatch {
            group,
            surface: batch.surface,
            vertices: resident.surface.vertices,
            drawn: resident.surface.drawn,
            bodies: batch.bodies as u32,
        });
    }
}

fn dispatch(
    mut context: RenderContext,
    device: Res<Device>,
    pipelines: Res<Pipelines>,
    cache: Res<PipelineCache>,
) {
    if device.dispatches.is_empty() {
        return;
    }
    let (Some(positions), Some(mesh)) =
        (cache.get_compute_pipeline(pipelines.positions), cache.get_compute_pipeline(pipelines.mesh))
    else {
        return;
    };
    let recorder = context.diagnostic_recorder();
    let mut pass = context
        .command_encoder()
        .begin_compute_pass(&ComputePassDescriptor { label: Some("pliant deform"), timestamp_writes: None });
    let span = recorder.as_deref().map(|recorder| recorder.pass_span(&mut pass, "pliant_deform"));
    for dispatch in &device.dispatches {
        pass.set_bind_group(0, &dispatch.group, &[dispatch.surface]);
        pass.set_pipeline(positions);
        pass.dispatch_workgroups(dispatch.vertices.div_ceil(WORKGROUP), dispatch.bodies, 1);
        pass.set_pipeline(mesh);
        pass.dispatch_workgroups(dispatch.drawn.div_ceil(WORKGROUP), dispatch.bodies, 1);
    }
    if let Some(span) = span {
        span.end(&mut pass);
    }
}

#[cfg(test)]
mod tests {
    use pliant_modal::ModalModel;

    use super::*;
    use crate::{deform::drawing::Drawings, tests::model};

    #[test]
    fn a_model_goes_to_a_device_that_holds_each_of_its_buffers() {
        // With one mode, the triangles take more memory than the basis.
        let mut parts = model::bar().parts().clone();
        let rows = parts.displacement.len() / parts.omega.len();
        parts.displacement.truncate(rows);
        parts.rotation.truncate(rows);
        parts.omega.truncate(1);
        parts.damping.truncate(1);
        parts.participation.truncate(1);
        let drawing = Drawings::default().get(&Arc::new(ModalModel::from_parts(parts).unwrap()), 0.9);
        let topology = &drawing.topology;
        let (starts, corners) = topology.corners();
        assert_eq!(topology.words(), 2 * topology.source.len() + starts.len() + 3 * corners.len());
        assert!(topology.tangents.is_empty(), "the bar has no texture");
        let bytes = 4 * topology.words() as u64;
        let basis = size_of_val(drawing.model.basis().rows().unwrap()) as u64;
        assert!(bytes > basis && bytes > 48 * topology.source.len() as u64, "{bytes}, {basis}");
        let takes = |binding: u64, buffer: u64| {
            let limits = WgpuLimits {
                max_storage_buffer_binding_size: binding,
                max_buffer_size: buffer,
                ..WgpuLimits::default()
            };
            Compute { limits, software: false }.takes(&drawing)
        };
        assert!(takes(bytes, bytes));
        assert!(!takes(bytes - 1, bytes));
        assert!(!takes(bytes, bytes - 1));
    }
}

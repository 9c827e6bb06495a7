//! Compares the compute pass with the processor, vertex by vertex.
//!
//! The vertex buffer that bodies are drawn from is read back from the device.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

mod drawing;

use std::{path::PathBuf, process::ExitCode, time::Duration};

use bevy::{
    app::{PluginsState, ScheduleRunnerPlugin},
    camera::{RenderTarget, primitives::Aabb},
    mesh::{MeshVertexAttribute, VertexAttributeValues},
    prelude::*,
    render::{
        RenderApp,
        mesh::{RenderMesh, allocator::MeshAllocator},
        pipelined_rendering::PipelinedRenderingPlugin,
        render_asset::RenderAssets,
        render_resource::{
            BufferDescriptor, BufferUsages, CommandEncoderDescriptor, MapMode, PollType, TextureFormat,
        },
        renderer::{RenderDevice, RenderQueue},
    },
    time::TimeUpdateStrategy,
    window::ExitCondition,
    winit::WinitPlugin,
};
use pliant::{
    body::{DrawnSurface, Driven, SurfaceDeformation, SurfaceDetail, VisualState},
    modal::{ModalModel, SurfaceMesh},
    prelude::*,
};

fn studio() -> App {
    let mut app = App::new();
    app.add_plugins(
        DefaultPlugins
            .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
            .disable::<WinitPlugin>()
            .disable::<PipelinedRenderingPlugin>(),
    )
    .add_plugins((ScheduleRunnerPlugin::run_once(), PliantPlugins::default()))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(25)))
    .insert_resource(SurfaceDeformation::Compute);
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();
    let world = app.world_mut();
    let canvas = Image::new_target_texture(64, 64, TextureFormat::Rgba8UnormSrgb, None);
    let canvas = world.resource_mut::<Assets<Image>>().add(canvas);
    world.spawn((
        Camera3d::default(),
        RenderTarget::from(canvas),
        Transform::from_xyz(0.0, 0.35, 3.0).looking_at(Vec3::new(0.0, 0.13, 0.0), Vec3::Y),
    ));
    app
}

fn pip() -> ModalModel {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    let mut parts = ModalModel::read(path).unwrap().parts().clone();
    // A texture that winds around Pip, so that the surface has tangents.
    let surface = &parts.surface;
    let wound = |p: &[f32; 3]| [p[0].atan2(p[2]), 8.0 * p[1]];
    parts.surface = SurfaceMesh::new(
        surface.positions().to_vec(),
        surface.triangles().to_vec(),
        Some(surface.positions().iter().map(wound).collect()),
        surface.anchored().to_vec(),
    )
    .unwrap();
    ModalModel::from_parts(parts).unwrap()
}

/// Positions, normals and tangents.
type Shape = [Vec<Vec3>; 3];

const ATTRIBUTES: [MeshVertexAttribute; 3] =
    [Mesh::ATTRIBUTE_POSITION, Mesh::ATTRIBUTE_NORMAL, Mesh::ATTRIBUTE_TANGENT];

/// Returns the vertices of a mesh from the buffer on the device. The torus has no tangents.
fn on_device(app: &App, mesh: AssetId<Mesh>) -> Shape {
    let world = app.sub_app(RenderApp).world();
    let layout = &world.resource::<RenderAssets<RenderMesh>>().get(mesh).unwrap().layout.0;
    let slice = world.resource::<MeshAllocator>().mesh_vertex_slice(&mesh).unwrap();
    let stride = layout.layout().array_stride;
    let bytes = u64::from(slice.range.start) * stride..u64::from(slice.range.end) * stride;
    let device = world.resource::<RenderDevice>();
    let copy = device.create_buffer(&BufferDescriptor {
        label: None,
        size: bytes.end - bytes.start,
        usage: BufferUsages::COPY_DST | BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&CommandEncoderDescriptor::default());
    encoder.copy_buffer_to_buffer(slice.buffer, bytes.start, &copy, 0, bytes.end - bytes.start);
    world.resource::<RenderQueue>().submit([encoder.finish()]);
    let view = copy.slice(..);
    device.map_buffer(&view, MapMode::Read, |result| result.unwrap());
    device.poll(PollType::wait_indefinitely()).unwrap();
    let data = view.get_mapped_range();
    let read = |attribute: MeshVertexAttribute| -> Vec<Vec3> {
        let Some(index) = layout.attribute_ids().iter().position(|id| *id == attribute.id) else {
            return Vec::new();
        };
        let offset = layout.layout().attributes[index].offset as usize;
        data.chunks_exact(stride as usize)
            .map(|vertex| {
                let number = |k: usize| {
                    f32::from_le_bytes(vertex[offset + 4 * k..offset + 4 * k + 4].try_into().unwrap())
                };
                Vec3::new(number(0), number(1), number(2))
            })
            .collect()
    };
    ATTRIBUTES.map(read)
}

fn in_asset(app: &App, mesh: AssetId<Mesh>) -> Shape {
    let mesh = app.world().resource::<Assets<Mesh>>().get(mesh).unwrap();
    let read = |attribute| match mesh.attribute(attribute) {
        Some(VertexAttributeValues::Float32x3(values)) => values.iter().map(|v| Vec3::from(*v)).collect(),
        Some(VertexAttributeValues::Float32x4(values)) => {
            values.iter().map(|&[x, y, z, _]| Vec3::new(x, y, z)).collect()
        }
        None => Vec::new(),
        other => panic!("{other:?}"),
    };
    ATTRIBUTES.map(read)
}

fn farthest(a: &[Vec3], b: &[Vec3]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

fn main() -> ExitCode {
    drawing::main(studio, &[("the_compute_pass_and_the_processor_draw_the_same_shapes", the_same_shapes)])
}

fn the_same_shapes(mut app: App) {
    let model = pip();
    let (size, modes) = (model.size() as f32, model.mode_count());
    // Value of the first mode's coordinate that turns some vertex by one radian.
    let turn = {
        let rotation = &model.parts().rotation[..model.surface().positions().len() * 3];
        1.0 / f64::from(rotation.chunks_exact(3).map(|w| Vec3::from_slice(w).length()).fold(0.0, f32::max))
    };
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    let material = app.world_mut().resource_mut::<Assets<StandardMaterial>>().add(Color::WHITE);
    // Another mesh must share the vertex buffer, to show that only the bodies are written.
    let other = app.world_mut().resource_mut::<Assets<Mesh>>().add(Torus::default());
    app.world_mut().spawn((Mesh3d(other.clone()), MeshMaterial3d(material.clone())));
    let torus = in_asset(&app, other.id());
    let bodies: Vec<Entity> = (0..3)
        .map(|i| {
            app.world_mut()
                .spawn((
                    ModalBody::new(handle.clone()),
                    Driven::Remote,
                    SurfaceDetail { tolerance: 0.0 },
                    MeshMaterial3d(material.clone()),
                    Transform::from_xyz(i as f32 * 0.5 - 0.5, 0.0, 0.0),
                ))
                .id()
        })
        .collect();
    app.update();
    app.update();

    // The deformations are gentle, strong, and beyond half a turn, where the series of the warp
    // ends.
    for (body, turns) in bodies.iter().zip([0.1, 1.0, 4.5]) {
        let q: Vec<f64> =
            (0..modes).map(|k| turns * turn * (0.7f64).powi(k as i32) * [1.0, -1.0][k % 2]).collect();
        app.world_mut().get_mut::<VisualState>(*body).unwrap().snap(&q).unwrap();
    }
    let meshes: Vec<AssetId<Mesh>> =
        bodies.iter().map(|body| app.world().get::<Mesh3d>(*body).unwrap().id()).collect();
    let rest = on_device(&app, meshes[0]);
    // The pipelines are compiled in the background.
    let computed = drawing::wait_for("the compute pass runs", || {
        app.update();
        let computed: Vec<_> = meshes.iter().map(|mesh| on_device(&app, *mesh)).collect();
        let moved: Vec<f32> = computed.iter().map(|shape| farthest(&shape[0], &rest[0])).collect();
        if moved.iter().all(|moved| *moved > 0.01 * size) {
            Ok(computed)
        } else {
            Err(format!("the bodies have moved by {moved:?} m"))
        }
    });
    for (mesh, body) in meshes.iter().zip(&bodies) {
        assert!(farthest(&in_asset(&app, *mesh)[0], &rest[0]) < 1e-6 * size, "the asset is not touched");
        let aabb = app.world().get::<Aabb>(*body).unwrap();
        let [shape, ..] = on_device(&app, *mesh);
        assert!(shape.iter().all(|p| {
            let p = bevy::math::Vec3A::from(*p);
            p.cmpge(aabb.min() - 1e-5).all() && p.cmple(aabb.max() + 1e-5).all()
        }));
    }
    assert_eq!(on_device(&app, other.id()), torus, "a neighbor in the buffer was written to");

    // The processor deforms the same shapes.
    app.insert_resource(SurfaceDeformation::Processor);
    app.update();
    app.update();
    for (mesh, [positions, normals, tangents]) in meshes.iter().zip(&computed) {
        let [expected, directions, along] = in_asset(&app, *mesh);
        let error = farthest(positions, &expected);
        assert!(error < 1e-5 * size, "off by {error} m of {size} m");
        // The error of a normal is the error of the positions divided by the length of an edge.
        let error = farthest(normals, &directions);
        assert!(error < 1e-2, "normals off by {error}");
        println!(
            "positions off by {:.2e} of the size, normals by {error:.2e}",
            farthest(positions, &expected) / size
        );
        // A tangent is a unit vector across its normal. Where the texture hardly grows along the
        // surface, its direction is rounding error.
        assert_eq!(tangents.len(), normals.len());
        for (tangent, normal) in tangents.iter().zip(normals) {
            assert!((tangent.length() - 1.0).abs() < 1e-4 && tangent.dot(*normal).abs() < 1e-3);
        }
        let mut errors: Vec<f32> = tangents.iter().zip(&along).map(|(a, b)| a.distance(*b)).collect();
        errors.sort_by(f32::total_cmp);
        let most = errors[errors.len() * 999 / 1000];
        println!("tangents off by {most:.2e} for 99.9 % of the vertices");
        assert!(most < 1e-2, "tangents off by {most}");
    }

    // In a picture of 64 pixels, most modes of a distant body are left out without a visible
    // change.
    let world = app.world_mut();
    world.entity_mut(bodies[0]).insert(SurfaceDetail::default());
    let q: Vec<f64> = world.get::<VisualState>(bodies[0]).unwrap().q().to_vec();
    world.get_mut::<VisualState>(bodies[0]).unwrap().snap(&q).unwrap();
    app.update();
    let error = farthest(&in_asset(&app, meshes[0])[0], &computed[0][0]);
    // The view covers 45 degrees over 64 pixels, at three meters less the radius of the body.
    let pixel = 2.0 * 3.0 * (22.5f32).to_radians().tan() / 64.0;
    assert!(error > 1e-6 * size, "every mode is drawn: {error}");
    assert!(error < 0.1 * pixel, "{error} m off, a pixel is {pixel} m");
    // With a small tolerance, every visible mode is drawn again, though the body has not moved.
    let world = app.world_mut();
    world.entity_mut(bodies[0]).insert(SurfaceDetail { tolerance: 1e-5 });
    app.update();
    let finer = farthest(&in_asset(&app, meshes[0])[0], &computed[0][0]);
    assert!(finer < error / 50.0, "{finer} m off after {error}");

    // A mesh that other code changes keeps its shape under the compute pass.
    app.insert_resource(SurfaceDeformation::Compute);
    app.update();
    let count = computed[2][0].len();
    app.world_mut()
        .resource_mut::<Assets<Mesh>>()
        .get_mut(meshes[2])
        .unwrap()
        .insert_attribute(Mesh::ATTRIBUTE_COLOR, vec![[1.0f32, 0.0, 0.0, 1.0]; count]);
    app.update();
    app.update();
    assert!(farthest(&on_device(&app, meshes[2])[0], &computed[2][0]) < 1e-5 * size);

    // Despawned bodies must leave no surface behind.
    for body in bodies {
        app.world_mut().entity_mut(body).despawn();
    }
    app.update();
    app.update();
    assert_eq!(app.world_mut().query::<&DrawnSurface>().iter(app.world()).count(), 0);
}

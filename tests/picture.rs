//! Tests what a user sees: the real renderer draws a body into an image, at rest and pulled.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

mod drawing;

use std::{
    path::PathBuf,
    process::ExitCode,
    sync::{Arc, Mutex},
    time::Duration,
};

use bevy::{
    app::{PluginsState, ScheduleRunnerPlugin},
    camera::RenderTarget,
    math::DVec3,
    prelude::*,
    render::{
        render_resource::{TextureFormat, TextureUsages},
        view::screenshot::{Screenshot, ScreenshotCaptured},
    },
    time::TimeUpdateStrategy,
    window::ExitCondition,
    winit::WinitPlugin,
};
use pliant::{modal::ModalModel, prelude::*};

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

/// The newest picture: rows of RGBA, 8 bits each.
#[derive(Resource, Clone, Default)]
struct Picture(Arc<Mutex<Option<Vec<u8>>>>);

#[derive(Resource)]
struct Canvas(Handle<Image>);

/// Creates an app that draws the body from the front into an image, with a light from the upper
/// left that casts its shadow.
fn studio() -> App {
    let model =
        ModalModel::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal")).unwrap();
    let mut app = App::new();
    app.add_plugins(
        DefaultPlugins
            .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
            .disable::<WinitPlugin>(),
    )
    .add_plugins((ScheduleRunnerPlugin::run_once(), PliantPlugins::default()))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(25)))
    .insert_resource(Time::<Fixed>::from_hz(40.0))
    .insert_resource(ClearColor(Color::BLACK))
    .init_resource::<Picture>();
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();

    let world = app.world_mut();
    let mut canvas = Image::new_target_texture(WIDTH, HEIGHT, TextureFormat::Rgba8UnormSrgb, None);
    canvas.texture_descriptor.usage |= TextureUsages::COPY_SRC;
    let canvas = world.resource_mut::<Assets<Image>>().add(canvas);
    let body = world.resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    let mut materials = world.resource_mut::<Assets<StandardMaterial>>();
    // The body is red and the ground is green, so that each is identified by its channel.
    let skin =
        materials.add(StandardMaterial { perceptual_roughness: 1.0, ..Color::srgb(1.0, 0.0, 0.0).into() });
    let floor =
        materials.add(StandardMaterial { perceptual_roughness: 1.0, ..Color::srgb(0.0, 1.0, 0.0).into() });
    let ground = world.resource_mut::<Assets<Mesh>>().add(Plane3d::default().mesh().size(4.0, 4.0));
    world.spawn((ModalBody::new(body), MeshMaterial3d(skin)));
    world.spawn((Mesh3d(ground), MeshMaterial3d(floor)));
    world.spawn((
        DirectionalLight { illuminance: 8_000.0, shadow_maps_enabled: true, ..default() },
        Transform::from_xyz(-1.0, 1.5, 0.6).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    world.spawn((
        Camera3d::default(),
        RenderTarget::from(canvas.clone()),
        Transform::from_xyz(0.0, 0.35, 0.9).looking_at(Vec3::new(0.0, 0.13, 0.0), Vec3::Y),
    ));
    world.insert_resource(Canvas(canvas));
    app
}

/// Runs frames and returns the picture of the last one.
fn shoot(app: &mut App, frames: usize) -> Vec<u8> {
    for _ in 0..frames {
        app.update();
    }
    let picture = app.world().resource::<Picture>().clone();
    let canvas = app.world().resource::<Canvas>().0.clone();
    let kept = picture.clone();
    app.world_mut().spawn(Screenshot::image(canvas)).observe(move |shot: On<ScreenshotCaptured>| {
        *kept.0.lock().unwrap() = shot.image.data.clone();
    });
    let bytes = drawing::wait_for("a picture is read back", || {
        app.update();
        picture.0.lock().unwrap().take().ok_or_else(|| "none has come".to_owned())
    });
    assert_eq!(bytes.len(), (WIDTH * HEIGHT * 4) as usize);
    bytes
}

/// Counts the pixels of the body, of the lit ground, and of the ground in shadow.
fn count(picture: &[u8]) -> [usize; 3] {
    let mut counts = [0; 3];
    for pixel in picture.chunks_exact(4) {
        let [red, green, _, _] = pixel.try_into().unwrap();
        if red > green {
            counts[0] += 1;
        } else if green > 150 {
            counts[1] += 1;
        } else if green > 10 {
            counts[2] += 1;
        }
    }
    counts
}

fn main() -> ExitCode {
    drawing::main(
        studio,
        &[("the_body_is_drawn_shadowed_and_pulled_out_of_shape", drawn_shadowed_and_pulled)],
    )
}

fn drawn_shadowed_and_pulled(mut app: App) {
    let all = (WIDTH * HEIGHT) as usize;
    let mut before = Vec::new();
    // The first frames compile the shaders; the picture is ready when two in a row agree.
    let rest = drawing::wait_for("the body and its shadow are drawn", || {
        let next = shoot(&mut app, 10);
        let still = next == before;
        before.clone_from(&next);
        let [body, lit, shadow] = count(&next);
        // 0.3 m of body at 0.9 m with a 45 degree lens is about a third of the height: a tenth of
        // the picture, within a factor of three.
        let right = (all / 30..all / 3).contains(&body) && lit > all / 10 && shadow > body / 20;
        let summary = || format!("{body} pixels of body, {lit} of lit ground, {shadow} of shadow, of {all}");
        if still && right { Ok(next) } else { Err(summary()) }
    });

    // An ear is pulled sideways by a quarter of the body's size.
    let world = app.world_mut();
    let (entity, vertex, start, size) = {
        let mut bodies = world.query::<(Entity, &BodyState)>();
        let (entity, state) = bodies.single(world).unwrap();
        let positions = state.model().surface().positions();
        let vertex =
            (0..positions.len()).max_by(|&a, &b| positions[a][0].total_cmp(&positions[b][0])).unwrap();
        (entity, vertex as u32, Vec3::from(positions[vertex]).as_dvec3(), state.model().size())
    };
    world.spawn((Grab::new(vertex, 0.06 * size, start + DVec3::new(0.25 * size, 0.0, 0.0)), GrabOf(entity)));
    let pulled = shoot(&mut app, 80);
    let width = |picture: &[u8]| {
        let columns =
            picture.chunks_exact(4).enumerate().filter(|(_, p)| p[0] > p[1]).map(|(i, _)| i as u32 % WIDTH);
        columns.max().unwrap_or(0)
    };
    assert!(
        width(&pulled) > width(&rest) + 10,
        "the right edge of the body is at column {} and was at {}",
        width(&pulled),
        width(&rest)
    );
}

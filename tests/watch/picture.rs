//! Draws a host's body at a tick of its trace with the host's own renderer, from where the page for
//! browsers looks: `tests/watch/run.sh` puts this picture beside the page's.
//!
//! ```sh
//! watch_picture TRACE BODY.modal TICK OUT.png WIDTH HEIGHT
//! ```
#![allow(missing_docs, reason = "a program for a test")]

#[path = "../../examples/session/mod.rs"]
mod session;

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use bevy::app::{PluginsState, ScheduleRunnerPlugin};
use bevy::camera::RenderTarget;
use bevy::camera::primitives::Aabb;
use bevy::prelude::*;
use bevy::render::render_resource::{TextureFormat, TextureUsages};
use bevy::render::view::screenshot::{Screenshot, save_to_disk};
use bevy::time::TimeUpdateStrategy;
use bevy::window::ExitCondition;
use bevy::winit::WinitPlugin;
use pliant::prelude::*;

/// Frames until shaders are compiled and the picture is there.
const FRAMES: usize = 60;
/// Longest time to the file.
const LONGEST: Duration = Duration::from_secs(120);

fn main() -> Result<(), Box<dyn Error>> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [trace, body, tick, out, width, height] = &given[..] else {
        return Err("expected TRACE BODY.modal TICK OUT.png WIDTH HEIGHT".into());
    };
    let model = session::model(Path::new(body))?;
    let truth = session::trace::truth(Path::new(trace))?;
    let q = truth.get(&tick.parse::<u64>()?).ok_or("the trace has no such tick")?;
    let q: Vec<f64> = q.iter().map(|q| f64::from(*q)).collect();

    let mut app = App::new();
    app.add_plugins(
        DefaultPlugins
            .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
            .disable::<WinitPlugin>(),
    )
    .add_plugins((ScheduleRunnerPlugin::run_once(), PliantPlugins::default()))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(25)))
    .insert_resource(Time::<Fixed>::from_hz(40.0))
    .insert_resource(ClearColor(Color::srgb_u8(0x16, 0x18, 0x1d)));
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();

    let world = app.world_mut();
    let (width, height) = (width.parse::<u32>()?, height.parse::<u32>()?);
    let mut canvas = Image::new_target_texture(width, height, TextureFormat::Rgba8UnormSrgb, None);
    canvas.texture_descriptor.usage |= TextureUsages::COPY_SRC;
    let canvas = world.resource_mut::<Assets<Image>>().add(canvas);
    let positions = model.surface().positions().to_vec();
    let bounds = Aabb::enclosing(positions.iter().map(|p| Vec3::from(*p))).ok_or("an empty surface")?;
    let asset = world.resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    // The color that watchers see where a body has no WatchView.
    let skin = StandardMaterial { perceptual_roughness: 0.6, ..Color::srgb(0.8, 0.8, 0.82).into() };
    let skin = world.resource_mut::<Assets<StandardMaterial>>().add(skin);
    world.spawn((ModalBody::new(asset), MeshMaterial3d(skin)));
    // As the page looks where the catalog has no camera (`Eye` in page/src/scene.ts): the angle is
    // that of the smaller side.
    let (middle, size) = (Vec3::from(bounds.center), 2.0 * Vec3::from(bounds.half_extents).length());
    let half = 22.5f32.to_radians();
    let eye = middle + Vec3::new(0.5, 0.4, 1.0).normalize() * 1.1 * size / 2.0 / half.sin();
    let fov = 2.0 * (half.tan() / (width as f32 / height as f32).min(1.0)).atan();
    let place = Transform::from_translation(eye).looking_at(middle, Vec3::Y);
    let key = place.rotation * Vec3::new(0.4, 0.8, 0.6);
    world.spawn((
        DirectionalLight { illuminance: 8_000.0, ..default() },
        Transform::from_translation(middle + key).looking_at(middle, Vec3::Y),
    ));
    world.spawn((
        Camera3d::default(),
        Projection::from(PerspectiveProjection { fov, near: size / 200.0, ..default() }),
        RenderTarget::from(canvas.clone()),
        place,
        AmbientLight { brightness: 600.0, ..default() },
    ));

    // A few ticks make the body; then time stands still, and the body is as the trace has it.
    for _ in 0..10 {
        app.update();
    }
    app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
    for _ in 0..FRAMES {
        let world = app.world_mut();
        let mut bodies = world.query::<(&mut BodyState, &mut VisualState)>();
        let (mut body, mut visual) = bodies.single_mut(world)?;
        let mut state = body.body().state().clone();
        state.q.clone_from(&q);
        state.v.fill(0.0);
        body.body_mut().set_state(&state)?;
        visual.snap(&q)?;
        app.update();
    }
    let file = PathBuf::from(out);
    if file.exists() {
        std::fs::remove_file(&file)?;
    }
    app.world_mut().spawn(Screenshot::image(canvas)).observe(save_to_disk(file.clone()));
    let began = Instant::now();
    while !file.exists() {
        app.update();
        if began.elapsed() > LONGEST {
            return Err("no picture came".into());
        }
    }
    Ok(())
}

//! A meadow of a thousand buds that share one model, and a ball that rolls through it.
//!
//! What to learn here: bodies share their model, so a thousand bodies use the memory of one model.
//! A body that nothing touches rests and is neither stepped nor uploaded. Diagnostics report the
//! cost of a tick and of a frame.
//!
//! ```sh
//! cargo run --release --example many_bodies
//! cargo run --release --example many_bodies -- --headless --shake    # all of them awake
//! ```

mod stage;

use bevy::{diagnostic::DiagnosticsStore, math::DVec3, prelude::*};
use clap::Parser;
use pliant::{
    body::{DEFORM_TIME, STEP_TIME},
    prelude::*,
};
use stage::{Look, Readout, Stage};

#[derive(Parser)]
struct Options {
    /// Number of bodies.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=20_000))]
    bodies: u32,
    /// Shake all bodies all the time, so that none rests.
    #[arg(long)]
    shake: bool,
    #[command(flatten)]
    stage: stage::Options,
}

/// Distance between buds, m.
const APART: f32 = 0.22;

fn main() -> AppExit {
    let options = Options::parse();
    App::new()
        .add_plugins(
            Stage::with("many bodies", options.stage)
                .key("left mouse: pull a bud")
                .key("S: shake them all")
                .look(Look { middle: Vec3::new(0.0, 0.1, 0.55), distance: 2.7, yaw: 0.5, pitch: 0.42 })
                .picture_at(1.7),
        )
        .add_plugins(PliantPlugins::default())
        .insert_resource(Meadow { bodies: options.bodies, shake: options.shake })
        .add_systems(Startup, plant)
        .add_systems(FixedUpdate, (roll, part, shake).chain().before(PliantSystems::Input))
        .add_systems(Update, write)
        .run()
}

#[derive(Resource)]
struct Meadow {
    bodies: u32,
    shake: bool,
}

/// The ball that pushes the buds apart.
#[derive(Component)]
struct Ball {
    radius: f32,
}

fn plant(
    mut commands: Commands,
    meadow: Res<Meadow>,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let colors = [(0.95, 0.50, 0.36), (0.96, 0.66, 0.34), (0.90, 0.40, 0.46), (0.93, 0.76, 0.52)];
    let skins = colors.map(|(red, green, blue)| {
        materials.add(StandardMaterial { perceptual_roughness: 0.5, ..Color::srgb(red, green, blue).into() })
    });
    let model = assets.load("bud.modal");
    // A disc of rows, sorted from the center outward; each bud is shifted a little at random.
    let side = (meadow.bodies as f32).sqrt().ceil() as i32 + 4;
    let mut places: Vec<Vec2> =
        (0..side * side).map(|i| IVec2::new(i % side - side / 2, i / side - side / 2).as_vec2()).collect();
    places.sort_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    for (number, place) in places.into_iter().take(meadow.bodies as usize).enumerate() {
        let odd = |salt: u32| {
            (number as u32).wrapping_mul(2_654_435_769).wrapping_add(salt).wrapping_mul(2_246_822_519) >> 8
        };
        let part = |salt| (odd(salt) % 1000) as f32 / 1000.0;
        let at = APART * (place + 0.5 * (Vec2::new(part(1), part(2)) - 0.5));
        commands.spawn((
            ModalBody::new(model.clone()),
            MeshMaterial3d(skins[odd(3) as usize % skins.len()].clone()),
            Transform::from_xyz(at.x, 0.0, at.y)
                .with_rotation(Quat::from_rotation_y(std::f32::consts::TAU * part(4)))
                .with_scale(Vec3::splat(0.8 + 0.4 * part(5))),
        ));
    }
    commands.spawn((
        Ball { radius: 0.24 },
        Mesh3d(
            meshes
                .add(Sphere::new(0.24).mesh().ico(5).unwrap_or_else(|_| Sphere::new(0.24).mesh().uv(32, 18))),
        ),
        MeshMaterial3d(
            materials
                .add(StandardMaterial { perceptual_roughness: 0.35, ..Color::srgb(0.30, 0.42, 0.58).into() }),
        ),
        Transform::from_xyz(0.0, 0.24, 0.0),
    ));
}

/// Moves the ball on loops across the meadow.
fn roll(time: Res<Time>, mut balls: Query<(&mut Transform, &Ball)>) {
    let t = 0.5 * time.elapsed_secs() - 0.6;
    for (mut place, ball) in &mut balls {
        place.translation =
            Vec3::new(2.2 * (1.3 * t).sin(), ball.radius, 1.7 * (2.1 * t).sin() * (0.3 * t).cos());
    }
}

/// Pushes the heads of the buds out of the ball.
fn part(
    balls: Query<(&Transform, &Ball)>,
    mut bodies: Query<(&mut BodyState, &VisualState, &GlobalTransform)>,
    mut top: Local<Option<u32>>,
) -> Result {
    for (ball, Ball { radius }) in &balls {
        for (mut state, shown, place) in &mut bodies {
            let foot = place.translation();
            // Only buds within reach are examined, and only pushed buds are woken.
            if foot.xz().distance(ball.translation.xz()) > radius + 0.3 {
                continue;
            }
            let head = *top.get_or_insert_with(|| highest(&state));
            let at = place.transform_point(surface_point(&state, head, shown.q()));
            let apart = at - ball.translation;
            let deep = radius + 0.05 - apart.length();
            if deep > 0.0 {
                let push = 120.0 * deep * Vec3::new(apart.x, 0.0, apart.z).normalize_or(Vec3::X);
                state.body_mut().push(head, push.as_dvec3().into())?;
            }
        }
    }
    Ok(())
}

fn highest(state: &BodyState) -> u32 {
    let positions = state.model().surface().positions();
    (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap_or(0) as u32
}

fn surface_point(state: &BodyState, vertex: u32, q: &[f64]) -> Vec3 {
    let model = state.model();
    let along = |axis| {
        q.iter().enumerate().map(|(mode, q)| q * f64::from(model.displacement_row(vertex, axis, mode))).sum()
    };
    let moved = DVec3::new(along(0), along(1), along(2));
    Vec3::from(model.surface().positions()[vertex as usize]) + moved.as_vec3()
}

/// Applies an impulse to every head.
fn shake(
    meadow: Res<Meadow>,
    tick: Res<PliantTick>,
    keys: Res<ButtonInput<KeyCode>>,
    mut bodies: Query<&mut BodyState>,
) -> Result {
    if keys.just_pressed(KeyCode::KeyS) || (meadow.shake && tick.0.is_multiple_of(32)) {
        for mut state in &mut bodies {
            let head = highest(&state);
            state.body_mut().apply_impulse(head, [0.02, 0.0, 0.01])?;
        }
    }
    Ok(())
}

fn write(bodies: Query<&BodyState>, diagnostics: Res<DiagnosticsStore>, mut readout: ResMut<Readout>) {
    let Some(one) = bodies.iter().next() else { return };
    let awake = bodies.iter().filter(|state| !state.is_resting()).count();
    let ms = |path| diagnostics.get(path).and_then(|found| found.smoothed()).unwrap_or(0.0);
    readout.0 = format!(
        "{} bodies of {} modes and {} vertices\n\
         awake   {awake:6}\n\
         step    {:6.3} ms a tick\n\
         deform  {:6.3} ms a frame",
        bodies.iter().len(),
        one.body().mode_count(),
        one.model().surface().positions().len(),
        ms(&STEP_TIME),
        ms(&DEFORM_TIME),
    );
}

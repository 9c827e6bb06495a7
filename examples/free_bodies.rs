//! Three bodies without anchors: one is thrown spinning, one is struck, one is held by two hands.
//!
//! What to learn here: a body baked without anchors moves freely, and so does its `Transform`.
//! Gravity, impulses and hands act on its rigid motion and on its shape. The change of its momentum
//! equals the sum of what was applied; the table on the screen shows both.
//!
//! ```sh
//! cargo run --release --example free_bodies
//! ```

mod stage;

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};
use pliant::{modal::Frame, prelude::*};
use stage::{Look, Readout, Stage};

/// Weak gravity, as on the moon, gives time to watch the motion.
const GRAVITY: DVec3 = DVec3::new(0.0, -1.62, 0.0);

/// Height from which the first body is thrown, m.
const LOW: f64 = -0.5;

fn main() -> AppExit {
    App::new()
        .add_plugins(
            Stage::new("free bodies")
                .key("left mouse: hold one")
                .key("H: hit the middle one")
                .look(Look { middle: Vec3::new(0.0, 0.0, 0.0), distance: 1.6, yaw: 0.25, pitch: 0.12 })
                .floating()
                .picture_at(2.6),
        )
        .add_plugins(PliantPlugins::default())
        .add_systems(Startup, spawn)
        .add_systems(
            FixedUpdate,
            (
                (throw, hit, take_hold, move_hands).chain().before(PliantSystems::Input),
                keep_account.after(PliantSystems::Publish),
            ),
        )
        .add_systems(Update, (draw, write))
        .run()
}

/// What is done to a body.
#[derive(Component, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Part {
    Thrown,
    Struck,
    Held,
}

/// The momentum of a body when its account was opened, and the momentum applied since.
#[derive(Component, Default)]
struct Account {
    /// Momentum when the account was opened, kg m/s; `None` before.
    opening: Option<DVec3>,
    /// Angular momentum about the body's center at that time, kg m^2/s.
    spin: DVec3,
    /// Momentum applied by hands, impulses and gravity since then, N s.
    applied: DVec3,
}

fn spawn(mut commands: Commands, assets: Res<AssetServer>, mut materials: ResMut<Assets<StandardMaterial>>) {
    let parts = [
        (Part::Thrown, 0.62, Color::srgb(0.95, 0.50, 0.36)),
        (Part::Struck, 0.0, Color::srgb(0.42, 0.66, 0.58)),
        (Part::Held, -0.62, Color::srgb(0.86, 0.68, 0.34)),
    ];
    for (part, x, color) in parts {
        let mut body = ModalBody::new(assets.load("jack.modal"));
        body.settings.gravity = if part == Part::Struck { [0.0; 3] } else { GRAVITY.into() };
        commands.spawn((
            body,
            part,
            Account::default(),
            MeshMaterial3d(materials.add(StandardMaterial {
                perceptual_roughness: 0.45,
                clearcoat: 0.3,
                ..color.into()
            })),
            Transform::from_xyz(x, if part == Part::Thrown { LOW as f32 } else { 0.0 }, 0.0),
        ));
    }
}

/// Throws the first body up each time it has fallen, spinning about none of its principal axes.
fn throw(mut bodies: Query<(&Part, &mut BodyState, &mut Account)>) -> Result {
    for (part, mut state, mut account) in &mut bodies {
        let body = state.body();
        let down = body.frame().center()[1] < LOW && body.frame().velocity()[1] < 0.0;
        if *part != Part::Thrown || !(account.opening.is_none() || down) {
            continue;
        }
        let mut thrown = body.state().clone();
        thrown.frame = Frame::from_motion(
            body.model(),
            [0.62, LOW, 0.0],
            body.frame().orientation(),
            [0.0, 1.4, 0.0],
            [1.1e-2, 0.4e-2, 1.6e-2],
        )?;
        state.body_mut().set_state(&thrown)?;
        *account = Account::default();
    }
    Ok(())
}

/// Strikes the second body on a knob, toward its place.
fn hit(
    time: Res<Time>,
    keys: Res<ButtonInput<KeyCode>>,
    mut bodies: Query<(Entity, &Part, &BodyState, &mut Account)>,
    mut impulses: MessageWriter<Impulse>,
    mut blows: Local<u32>,
) {
    let due = time.elapsed_secs_f64() > 0.4 + 1.5 * f64::from(*blows);
    if !due && !keys.just_pressed(KeyCode::KeyH) {
        return;
    }
    for (body, part, state, mut account) in &mut bodies {
        if *part != Part::Struck || account.opening.is_none() {
            continue;
        }
        *blows += u32::from(due);
        let (momentum, _) = state.body().momentum();
        let home = -DVec3::from(state.body().frame().origin());
        let impulse = -DVec3::from(momentum) + 0.18 * home + 0.04 * DVec3::new(0.3, 1.0, 0.6);
        let side = [Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::NEG_Y][*blows as usize % 4];
        impulses.write(Impulse { body, vertex: farthest(state, side), impulse });
        account.applied += impulse;
    }
}

/// Returns the surface vertex farthest along `toward`, in body axes.
fn farthest(state: &BodyState, toward: Vec3) -> u32 {
    let positions = state.model().surface().positions();
    let along = |i: usize| Vec3::from(positions[i]).dot(toward);
    (0..positions.len()).max_by(|&a, &b| along(a).total_cmp(&along(b))).unwrap_or(0) as u32
}

/// A scripted hand on the left or the right knob.
#[derive(Component)]
struct Hand {
    side: f64,
}

/// Grabs the third body with two hands.
fn take_hold(
    mut commands: Commands,
    bodies: Query<(Entity, &Part, &BodyState, &GlobalTransform), Added<BodyState>>,
) {
    for (body, part, state, place) in &bodies {
        for side in [-1.0_f64, 1.0] {
            if *part == Part::Held {
                let knob = farthest(state, side as f32 * Vec3::X);
                let at =
                    place.transform_point(Vec3::from(state.model().surface().positions()[knob as usize]));
                commands.spawn((Grab::new(knob, 0.04, at), GrabOf(body), Hand { side }));
            }
        }
    }
}

/// Pulls, twists and swings the third body.
fn move_hands(time: Res<Time>, mut hands: Query<(&Hand, &mut Grab)>) {
    let t = time.elapsed_secs_f64();
    let gently = (t / 1.5).min(1.0);
    let middle = DVec3::new(-0.62, 0.10 * gently * (1.9 * t).sin(), 0.08 * gently * (1.3 * t).sin());
    // The hands turn about each other, and their distance changes.
    let turned =
        DQuat::from_euler(EulerRot::YZX, gently * 0.9 * (1.1 * t).sin(), gently * 0.7 * (1.7 * t).sin(), 0.0);
    let half = 0.205 + 0.02 * gently * (2.6 * t).sin();
    for (Hand { side }, mut grab) in &mut hands {
        grab.target = middle + turned * DVec3::new(*side * half, 0.0, 0.0);
    }
}

/// Sums the momentum that was applied in this tick.
fn keep_account(
    time: Res<Time>,
    mut bodies: Query<(&BodyState, &ModalBody, &mut Account, Option<&Grabs>)>,
    forces: Query<&GrabForce>,
) {
    for (state, settings, mut account, grabs) in &mut bodies {
        let (momentum, _) = state.body().momentum();
        if account.opening.is_none() {
            *account = Account {
                opening: Some(momentum.into()),
                spin: state.body().frame().spin().into(),
                applied: DVec3::ZERO,
            };
            continue;
        }
        let hands: DVec3 = grabs
            .into_iter()
            .flat_map(|grabs| forces.iter_many(grabs.entities()))
            .map(|felt| -felt.force)
            .sum();
        account.applied +=
            (hands + state.model().mass() * DVec3::from(settings.settings.gravity)) * time.delta_secs_f64();
    }
}

/// Draws momentum and angular momentum as arrows, and hands as balls.
fn draw(
    mut gizmos: Gizmos,
    bodies: Query<(&BodyState, &GlobalTransform)>,
    hands: Query<(&Grab, &GrabForce), Without<PointerHeld>>,
) {
    for (state, place) in &bodies {
        let middle = place.transform_point(DVec3::from(state.model().center_of_mass()).as_vec3());
        let (momentum, _) = state.body().momentum();
        let arrow = 0.5 * DVec3::from(momentum).as_vec3();
        gizmos.arrow(middle, middle + arrow, Color::srgb(0.85, 0.1, 0.15));
        let spin = 12.0 * DVec3::from(state.body().frame().spin()).as_vec3();
        gizmos.arrow(middle, middle + spin, Color::srgb(0.15, 0.3, 0.8));
    }
    for (grab, felt) in &hands {
        gizmos.sphere(grab.target.as_vec3(), 0.014, Color::srgb(0.25, 0.25, 0.3));
        gizmos.line(felt.point.as_vec3(), grab.target.as_vec3(), Color::srgb(0.25, 0.25, 0.3));
    }
}

fn write(bodies: Query<(&Part, &BodyState, &Account)>, mut readout: ResMut<Readout>) {
    let mut text = format!("{:22}{:24}{:25}", "momentum, kg m/s", "since then", "applied since then");
    text += "missing\n";
    for (part, state, account) in bodies.iter().sort::<&Part>() {
        let Some(opening) = account.opening else { continue };
        let name = match part {
            Part::Thrown => "thrown: gravity",
            Part::Struck => "struck: blows",
            Part::Held => "held: hands, gravity",
        };
        let (momentum, _) = state.body().momentum();
        let change = DVec3::from(momentum) - opening;
        let three = |v: DVec3| format!("{:6.3} {:6.3} {:6.3}", v.x, v.y, v.z);
        let missing = (change - account.applied).length();
        text += &format!("{name:20}  {}    {}    {missing:.0e}\n", three(change), three(account.applied));
    }
    for (_, state, account) in bodies.iter().filter(|(part, ..)| **part == Part::Thrown) {
        let spin = DVec3::from(state.body().frame().spin());
        let change = (spin - account.spin).length() / spin.length();
        text += &format!("thrown: spin {:.4} kg m^2/s, changed by {change:.0e} of it", spin.length());
    }
    readout.0 = text;
}

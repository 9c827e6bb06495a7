//! Two users pull one body in one window, each half showing what one user sees.
//!
//! On the left, the host pulls with the mouse. On the right, a guest behind the paper's first
//! network pulls with the arrow keys. The guest is a complete app on its own thread, connected over
//! QUIC.
//!
//! What to learn here: the host plays in its own session. Two views of one body agree although the
//! guest's link has 200 ms round trip and 9 % loss. [`VisualState::snap`] draws a body that other
//! code moves.
//!
//! ```sh
//! cargo run --release --example tug_of_war
//! ```

mod guest;
#[path = "../session/mod.rs"]
mod session;
#[path = "../stage/mod.rs"]
mod stage;

use std::error::Error;
use std::sync::atomic::Ordering;

use bevy::camera::Viewport;
use bevy::camera::visibility::RenderLayers;
use bevy::math::DVec3;
use bevy::prelude::*;
use clap::Parser;
use pliant::net::{HandOf, HostConfig, NetPlugin, SharedBody, User, UserLink, Yourself};
use pliant::prelude::*;
use pliant::stream::emulator::Preset;

use guest::Other;

/// Two users pull one body.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The network between the two: none, paper-1 to paper-4, lan, wifi and others.
    #[arg(long, default_value = "paper-1", value_parser = session::network)]
    network: std::option::Option<Preset>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let stage = stage::Stage::with("tug of war", options.stage)
        .bare()
        .real_time()
        .picture_at(9.0)
        .key("left mouse: pull on the left")
        .key("arrows: pull on the right");
    let net = NetPlugin::host(HostConfig { name: "left".into(), ..default() })?;
    let invite = net.invite().cloned().ok_or("no invite")?;
    let other = Other::default();
    // The model is the largest transfer over such a network, so both users have it already.
    let model = session::model("pip.modal".as_ref())?;
    let thread = guest::start(&invite, model, session::emulation(options.network, 5), other.clone())?;
    App::new()
        .add_plugins(stage)
        .add_plugins((PliantPlugins::default(), net))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .insert_resource(other.clone())
        .init_resource::<Score>()
        .init_gizmo_group::<RightGizmos>()
        .insert_resource(ClearColor(Color::srgb(0.665, 0.695, 0.73)))
        .add_systems(Startup, setup)
        .add_systems(FixedUpdate, session::play.before(PliantSystems::Input))
        .add_systems(Update, (split, steer, mirror, draw_hands, score).chain())
        .run();
    other.stop.store(true, Ordering::Relaxed);
    thread.join().map_err(|_| "the guest's thread stopped")?;
    Ok(())
}

/// Marks the body that shows the guest's view.
#[derive(Component)]
struct Mirrored;

/// A half of the window.
#[derive(Component)]
struct Half {
    right: bool,
}

/// Gizmos of the right half.
#[derive(Default, Reflect, GizmoConfigGroup)]
struct RightGizmos;

fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut gizmos: ResMut<GizmoConfigStore>,
    unattended: Option<Res<stage::Unattended>>,
) {
    let skin = materials.add(Color::srgb(0.95, 0.50, 0.36));
    let body = ModalBody::new(assets.load("pip.modal"));
    let mut own = commands.spawn((
        body.clone(),
        SharedBody::named(session::BODY),
        MeshMaterial3d(skin.clone()),
        Transform::default(),
    ));
    if unattended.is_some() {
        own.insert(session::Script {
            toward: DVec3::new(-1.0, 0.55, 0.0),
            pull: DVec3::new(-0.12, 0.03, 0.05),
            rate: 1.3,
        });
    }
    commands.spawn((
        body,
        Mirrored,
        Driven::Remote,
        NoPointerGrab,
        MeshMaterial3d(skin),
        RenderLayers::layer(1),
        Transform::default(),
    ));
    let both = RenderLayers::from_layers(&[0, 1]);
    let floor = Mesh3d(meshes.add(Circle::new(1.2)));
    let flat = Transform::from_rotation(Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2));
    commands.spawn((floor, MeshMaterial3d(materials.add(Color::srgb(0.62, 0.66, 0.70))), flat, both.clone()));
    commands.spawn((
        DirectionalLight { shadow_maps_enabled: true, ..default() },
        Transform::from_xyz(1.0, 3.0, 2.0).looking_at(Vec3::ZERO, Vec3::Y),
        both,
    ));
    for right in [false, true] {
        commands.spawn((
            Camera3d::default(),
            Camera { order: isize::from(right), ..default() },
            AmbientLight { brightness: 350.0, ..default() },
            Transform::from_xyz(0.0, 0.32, 0.98).looking_at(Vec3::Y * 0.15, Vec3::Y),
            RenderLayers::layer(usize::from(right)),
            Half { right },
        ));
    }
    // This camera draws the text above both halves.
    commands.spawn((
        Camera2d,
        Camera { order: 2, clear_color: ClearColorConfig::None, ..default() },
        RenderLayers::none(),
        IsDefaultUiCamera,
    ));
    gizmos.config_mut::<RightGizmos>().0.render_layers = RenderLayers::layer(1);
}

/// Gives each camera its half of the window, whatever the size.
fn split(windows: Query<&Window>, mut cameras: Query<(&mut Camera, &Half)>) {
    let Ok(window) = windows.single() else { return };
    let size = window.physical_size();
    // The two halves leave a thin line between them.
    let half = UVec2::new((size.x / 2).saturating_sub(1).max(1), size.y.max(1));
    for (mut camera, part) in &mut cameras {
        let physical_position = UVec2::new(if part.right { size.x - half.x } else { 0 }, 0);
        let now = camera.viewport.as_ref().map(|view| (view.physical_position, view.physical_size));
        if now != Some((physical_position, half)) {
            camera.viewport = Some(Viewport { physical_position, physical_size: half, ..default() });
        }
    }
}

/// Moves the guest's hand with the arrow keys.
fn steer(
    keys: Option<Res<ButtonInput<KeyCode>>>,
    other: Res<Other>,
    unattended: Option<Res<stage::Unattended>>,
    time: Res<Time>,
) {
    let t = time.elapsed_secs_f64();
    let stick = match keys {
        _ if unattended.is_some() => {
            Some(DVec3::new(0.4 + 0.15 * (1.1 * t).sin(), 0.2 * (1.7 * t).sin(), 0.2 * (0.7 * t).cos()))
        }
        Some(keys) => {
            let axis = |more, less| f64::from(i8::from(keys.pressed(more)) - i8::from(keys.pressed(less)));
            let stick = DVec3::new(
                axis(KeyCode::ArrowRight, KeyCode::ArrowLeft),
                axis(KeyCode::ArrowUp, KeyCode::ArrowDown),
                0.0,
            );
            (stick != DVec3::ZERO).then_some(stick)
        }
        None => None,
    };
    other.view().stick = stick;
}

/// Copies the guest's visual state to the body on the right.
fn mirror(other: Res<Other>, mut bodies: Query<&mut VisualState, With<Mirrored>>) {
    let view = other.view();
    for mut visual in &mut bodies {
        // A resting body is not drawn again.
        if view.q.len() == visual.q().len()
            && view.q != visual.q()
            && let Err(error) = visual.snap(&view.q)
        {
            warn_once!("{error}");
        }
    }
}

fn draw_hands(
    other: Res<Other>,
    hands: Query<(&Grab, &GrabForce)>,
    mut left: Gizmos,
    mut right: Gizmos<RightGizmos>,
) {
    let [warm, cool] = [Color::srgb(1.0, 0.80, 0.30), Color::srgb(0.25, 0.55, 1.0)];
    let view = other.view();
    for (grab, reaction) in &hands {
        stage::draw_hand(&mut left, grab.target, Some(reaction.point), -reaction.force, warm);
    }
    for &(target, point, force) in &view.hands {
        stage::draw_hand(&mut right, target, Some(point), -force, cool);
    }
}

#[derive(Resource, Default)]
struct Score {
    left: u32,
    right: u32,
    /// Time for which one side has had the head, s, and that side.
    ahead: (f64, i8),
}

/// Displacement of the head in sizes of the body, and the time to hold it, s, for a point.
const ASIDE: f32 = 0.08;
const LONG: f64 = 1.5;

fn score(
    time: Res<Time>,
    bodies: Query<(&BodyState, &VisualState), With<SharedBody>>,
    forces: Query<(&GrabForce, Has<HandOf>), With<Grab>>,
    links: Query<&UserLink, (With<User>, Without<Yourself>)>,
    other: Res<Other>,
    mut score: ResMut<Score>,
    mut readout: ResMut<stage::Readout>,
) {
    let Ok((state, visual)) = bodies.single() else { return };
    let model = state.model();
    let positions = model.surface().positions();
    let Some(top) = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])) else {
        return;
    };
    let q = visual.q();
    let aside: f64 = q
        .iter()
        .enumerate()
        .map(|(mode, q)| q * f64::from(model.displacement_row(top as u32, 0, mode)))
        .sum();
    let part = (aside / model.size()) as f32;
    let side = if part < -ASIDE { -1 } else { i8::from(part > ASIDE) };
    let held = if side == score.ahead.1 { score.ahead.0 + time.delta_secs_f64() } else { 0.0 };
    score.ahead = (held, side);
    if side != 0 && held > LONG {
        score.ahead.0 = 0.0;
        if side < 0 { score.left += 1 } else { score.right += 1 }
    }
    let pull = |guests: bool| {
        forces
            .iter()
            .filter(|(_, of)| *of == guests)
            .map(|(reaction, _)| reaction.force.length())
            .fold(0.0, f64::max)
    };
    let link = links.iter().next().copied().unwrap_or_default();
    let text = format!(
        "left {} : {} right\nleft pulls  {:5.2} N\nright pulls {:5.2} N, and feels {:5.2} N\nbetween them {:.0} ms, {:.0} % lost",
        score.left,
        score.right,
        pull(false),
        pull(true),
        other.view().reaction,
        link.round_trip.as_secs_f64() * 1e3,
        link.loss_in.max(link.loss_out) * 100.0,
    );
    if readout.0 != text {
        readout.0 = text;
    }
}

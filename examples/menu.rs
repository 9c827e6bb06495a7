//! A menu: host a session, or join one by a pasted invite, play, leave, and host again, without a
//! restart.
//!
//! What to learn here: [`NetPlugin::default`] has no session, and commands begin and leave one.
//! [`SessionState`] says which part of the menu to show, and observers hear how a session ends.
//! [`SharedBody`] is on a body of the app's own, which a host shares, and in which a guest sees the
//! body of its host. After the session it is the app's own again.
//!
//! ```sh
//! cargo run --release --example menu
//! cargo run --release --example menu -- "pliant://…"   # with this invite in the field
//! ```

#[path = "session/mod.rs"]
mod session;
#[path = "stage/mod.rs"]
mod stage;

use bevy::prelude::*;
use clap::Parser;
use pliant::net::{
    HandOf, HostConfig, JoinConfig, NetHost, NetPlugin, RemoteHands, SessionClosed, SessionFailed,
    SessionJoined, SharedBody, User, UserJoined, UserLeft, color_of,
};
use pliant::panel::bevy_egui::EguiPrimaryContextPass;
use pliant::panel::{bevy_egui::EguiContexts, egui};
use pliant::prelude::*;

/// Hosts and joins sessions by a menu.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The invite that is in the field at first.
    #[arg(default_value = "")]
    invite: String,

    /// Your name in the sessions.
    #[arg(long, default_value = "player")]
    name: String,
}

/// What the user has typed, and what there is to tell.
#[derive(Resource)]
struct Menu {
    name: String,
    invite: String,
    /// Why there is no session any more, or none yet.
    message: String,
}

fn main() {
    let options = Options::parse();
    session::end_on_terminate();
    let stage = stage::Stage::with("menu", options.stage).real_time().key("left mouse: pull the body");
    App::new()
        .add_plugins(stage)
        .add_plugins((PliantPlugins::default(), NetPlugin::default()))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .insert_resource(Menu { name: options.name, invite: options.invite, message: String::new() })
        .add_observer(joined)
        .add_observer(closed)
        .add_observer(failed)
        .add_systems(Startup, setup)
        .add_systems(EguiPrimaryContextPass, show)
        .add_systems(FixedUpdate, session::play.before(PliantSystems::Input))
        .add_systems(
            Update,
            (draw_hands, read_out, play_the_user.run_if(resource_exists::<stage::Unattended>)),
        )
        .run();
}

fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    unattended: Option<Res<stage::Unattended>>,
) {
    let mut body = commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        SharedBody::named(session::BODY),
        MeshMaterial3d(materials.add(Color::srgb(0.95, 0.50, 0.36))),
    ));
    if unattended.is_some() {
        body.insert(session::Script::of(0));
    }
}

/// Shows the menu, which asks for sessions by commands.
fn show(
    mut contexts: EguiContexts,
    mut commands: Commands,
    mut menu: ResMut<Menu>,
    state: Res<SessionState>,
    host: Option<Res<NetHost>>,
    users: Query<&User>,
) -> Result {
    let menu = &mut *menu;
    let place = egui::Align2::LEFT_CENTER;
    let window = egui::Window::new("Session").anchor(place, [14.0, 0.0]).resizable(false);
    window.show(contexts.ctx_mut()?, |ui| {
        match *state {
            SessionState::Idle => {
                ui.label(&menu.message);
                if ui.button("Host").clicked() {
                    host_session(&mut commands, menu);
                }
                ui.horizontal(|ui| {
                    ui.add(egui::TextEdit::singleline(&mut menu.invite).hint_text("paste an invite"));
                    if ui.button("Join").clicked() {
                        join_session(&mut commands, menu);
                    }
                });
                return;
            }
            SessionState::Opening => ui.label("opening the socket"),
            SessionState::Joining => ui.label("joining"),
            SessionState::Lost => ui.label("lost the host, trying again"),
            SessionState::Hosting | SessionState::Joined => {
                ui.label(users.iter().map(|user| user.name.as_str()).collect::<Vec<_>>().join(", "))
            }
        };
        ui.horizontal(|ui| {
            if ui.button("Leave").clicked() {
                commands.leave_session();
            }
            if let Some(invite) = host.and_then(|host| host.invite())
                && ui.button("Copy the invite").clicked()
            {
                ui.ctx().copy_text(invite.to_string());
            }
        });
    });
    Ok(())
}

fn host_session(commands: &mut Commands, menu: &mut Menu) {
    menu.message.clear();
    commands.host_session(HostConfig { name: menu.name.clone(), ..default() });
}

fn join_session(commands: &mut Commands, menu: &mut Menu) {
    menu.message.clear();
    commands.join_session(menu.invite.as_str(), JoinConfig { name: menu.name.clone(), ..default() });
}

fn joined(joined: On<SessionJoined>, host: Option<Res<NetHost>>) {
    match host.and_then(|host| host.invite()) {
        Some(invite) => println!("hosting: {invite}"),
        None => println!("joined as user {}", joined.user.0),
    }
}

/// Clears what the session has displayed, also where the user has not asked to leave.
fn closed(closed: On<SessionClosed>, mut commands: Commands, mut menu: ResMut<Menu>) {
    menu.message = format!("The session is over: {}", closed.reason);
    println!("{}", menu.message);
    commands.leave_session();
}

fn failed(failed: On<SessionFailed>, mut commands: Commands, mut menu: ResMut<Menu>) {
    menu.message = failed.reason.to_string();
    println!("failed: {}", menu.message);
    commands.leave_session();
}

/// Plays the user where nobody is there: hosts, leaves, joins by the invite of the command line,
/// leaves, and hosts again.
fn play_the_user(
    mut commands: Commands,
    mut menu: ResMut<Menu>,
    time: Res<Time<Real>>,
    state: Res<SessionState>,
    awaited: Query<Entity, With<stage::Awaited>>,
    mut course: Local<(usize, f64)>,
) {
    /// How long each session lasts, s.
    const STAY: f64 = 0.5;
    let (step, since) = &mut *course;
    let now = time.elapsed_secs_f64();
    match (*step, *state) {
        (0, SessionState::Idle) => host_session(&mut commands, &mut menu),
        (2, SessionState::Idle) if !menu.invite.is_empty() => join_session(&mut commands, &mut menu),
        (2, SessionState::Idle) => *step = 3,
        (3, SessionState::Idle) if !menu.message.is_empty() => {}
        (4, SessionState::Idle) => host_session(&mut commands, &mut menu),
        (1 | 3, SessionState::Hosting | SessionState::Joined) if now > *since + STAY => {
            commands.leave_session();
        }
        (1 | 3, SessionState::Opening | SessionState::Joining) => {
            *since = now;
            return;
        }
        _ => return,
    }
    (*step, *since) = (*step + 1, now);
    if *step == 1 {
        // The run is counted from when the user has been everywhere.
        commands.spawn(stage::Awaited);
    } else if *step == 5 {
        awaited.iter().for_each(|entity| commands.entity(entity).despawn());
    }
}

/// Draws the hands of the others, on a host and on a guest, each in the color of its user.
fn draw_hands(
    guests: Query<(&Grab, &GrabForce, &HandOf)>,
    bodies: Query<&RemoteHands>,
    users: Query<&User>,
    mut gizmos: Gizmos,
) {
    for (grab, felt, of) in &guests {
        let Ok(user) = users.get(of.0) else { continue };
        stage::draw_hand(&mut gizmos, grab.target, Some(felt.point), -felt.force, user.color);
    }
    for hand in bodies.iter().flat_map(|seen| &seen.0) {
        stage::draw_hand(&mut gizmos, hand.target, None, -hand.reaction, color_of(hand.user));
    }
}

fn read_out(
    mut joined: MessageReader<UserJoined>,
    mut left: MessageReader<UserLeft>,
    state: Res<SessionState>,
    mut readout: ResMut<stage::Readout>,
) {
    joined.read().for_each(|user| println!("{} has joined", user.name));
    left.read().for_each(|user| println!("{} has left: {}", user.name, user.reason));
    let text = format!("{:?}", *state);
    if readout.0 != text {
        readout.0 = text;
    }
}

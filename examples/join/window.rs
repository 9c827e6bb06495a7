//! The window of a guest: the bodies that arrive, and the hands of all users.

use std::error::Error;

use bevy::prelude::*;
use pliant::net::{NetPlugin, NetStats, RemoteBody, RemoteHands, User, color_of};
use pliant::prelude::*;

use crate::{Options, finish, stage};

pub fn run(options: &Options, net: NetPlugin) -> Result<(), Box<dyn Error>> {
    let mut app = App::new();
    app.add_plugins(
        stage::Stage::with("join", options.stage.clone())
            .real_time()
            .picture_at(4.0)
            .key("left mouse: pull the body"),
    )
    .add_plugins((PliantPlugins::default(), net))
    .insert_resource(bevy::winit::WinitSettings::continuous())
    .add_systems(Update, (dress, draw_hands, read_out));
    finish(&mut app, options)?;
    // The stage ends the run, after the picture if a picture is taken.
    app.insert_resource(crate::session::EndAfter::default());
    crate::session::ended(&app.run())
}

/// Gives each new body a material.
fn dress(
    mut commands: Commands,
    bodies: Query<Entity, Added<RemoteBody>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    for body in &bodies {
        commands.entity(body).insert(MeshMaterial3d(materials.add(Color::srgb(0.95, 0.50, 0.36))));
    }
}

/// Draws the remote hands, each in the color of its user, and how hard they pull.
fn draw_hands(bodies: Query<&RemoteHands>, mut gizmos: Gizmos) {
    for hand in bodies.iter().flat_map(|seen| &seen.0) {
        stage::draw_hand(&mut gizmos, hand.target, None, -hand.reaction, color_of(hand.user));
    }
}

fn read_out(stats: Res<NetStats>, users: Query<&User>, mut readout: ResMut<stage::Readout>) {
    let names: Vec<&str> = users.iter().map(|user| user.name.as_str()).collect();
    let text = format!(
        "round trip {:6.1} ms\nloss       {:6.1} %\nreceived   {:6.0} kbit/s\nhere: {}",
        stats.round_trip.as_secs_f64() * 1e3,
        stats.loss_in * 100.0,
        stats.bytes_in_per_s * 8e-3,
        names.join(", "),
    );
    if readout.0 != text {
        readout.0 = text;
    }
}

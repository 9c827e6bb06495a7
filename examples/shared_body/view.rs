//! The window: the guest's body, a ghost of the host's true state, hands, and metrics in a corner.

use bevy::{
    light::{NotShadowCaster, NotShadowReceiver},
    prelude::*,
};
use pliant::{prelude::*, rerun::RerunStyle};

use crate::{
    guest::{GuestBody, Metrics},
    meter::{Meters, Truth},
    stage::{Look, Readout, Setting},
};

/// A translucent body that shows the host's newest state without a network in between.
#[derive(Component)]
pub struct Ghost;

/// Whether the ghost is shown.
#[derive(Resource)]
struct GhostOn(bool);

/// The stage of the examples, the body, the ghost and the hands.
pub struct ViewPlugin {
    /// Title above the metrics.
    pub title: String,
}

impl Plugin for ViewPlugin {
    fn build(&self, app: &mut App) {
        app.add_plugins(Setting {
            title: self.title.clone(),
            keys: vec!["left mouse: pull the body", "G: ghost of the host's truth", "F1: panel"],
            look: Some(Look::default()),
            floor: true,
        })
        .insert_resource(Readout("joining ...".into()))
        .insert_resource(GhostOn(true))
        .add_systems(Update, (dress, ghost_follows, keys, draw_hands, write_metrics, frame_body).chain());
    }
}

/// Gives the body its material once it exists, and spawns the ghost.
fn dress(
    mut commands: Commands,
    mut materials: ResMut<Assets<StandardMaterial>>,
    bodies: Query<(Entity, &ModalBody), (With<GuestBody>, Without<MeshMaterial3d<StandardMaterial>>)>,
    ghosts: Query<(), With<Ghost>>,
) {
    for (entity, body) in &bodies {
        commands.entity(entity).insert(MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.95, 0.50, 0.36),
            perceptual_roughness: 0.42,
            reflectance: 0.45,
            clearcoat: 0.25,
            clearcoat_perceptual_roughness: 0.35,
            ..default()
        })));
        if ghosts.is_empty() {
            commands.spawn((
                Name::new("ghost"),
                Ghost,
                body.clone(),
                Driven::Remote,
                NoPointerGrab,
                RerunStyle::Points,
                NotShadowCaster,
                NotShadowReceiver,
                MeshMaterial3d(materials.add(StandardMaterial {
                    base_color: Color::srgba(0.25, 0.55, 1.0, 0.26),
                    alpha_mode: AlphaMode::Blend,
                    unlit: true,
                    // Where both surfaces agree, the body covers the ghost; otherwise their colors
                    // would mix.
                    depth_bias: -60_000.0,
                    ..default()
                })),
            ));
        }
    }
}

/// Copies the host's newest state to the ghost, without a network.
fn ghost_follows(
    truth: Res<Truth>,
    on: Res<GhostOn>,
    mut ghosts: Query<(&mut VisualState, &mut Visibility), With<Ghost>>,
) {
    for (mut shown, mut visibility) in &mut ghosts {
        visibility.set_if_neq(if on.0 { Visibility::Inherited } else { Visibility::Hidden });
        if let Some((_, q)) = truth.newest()
            // A resting ghost is not drawn and recorded again.
            && *shown.q() != *q
        {
            // While the body changes, the number of modes can differ for a moment; the ghost then
            // keeps its shape.
            shown.snap(&q).ok();
        }
    }
}

fn keys(input: Res<ButtonInput<KeyCode>>, mut ghost: ResMut<GhostOn>, mut exit: MessageWriter<AppExit>) {
    if input.just_pressed(KeyCode::KeyG) {
        ghost.0 = !ghost.0;
    }
    if input.just_pressed(KeyCode::Escape) {
        exit.write(AppExit::Success);
    }
}

/// Fits the camera to the size of the body.
fn frame_body(
    bodies: Query<(&BodyState, &GlobalTransform), (With<GuestBody>, Added<BodyState>)>,
    mut look: ResMut<Look>,
) {
    for (state, place) in &bodies {
        let [low, high] = state.model().surface().bounds();
        let middle = (Vec3::from(low) + Vec3::from(high)) / 2.0;
        look.middle = place.transform_point(middle);
        look.distance = 2.3 * state.model().size() as f32;
    }
}

/// Draws every hand: a ball at its target, a line to its patch, and the reaction as an arrow.
fn draw_hands(mut gizmos: Gizmos, bodies: Query<(&HeldBy, &BodyState), With<GuestBody>>) {
    for (held, state) in &bodies {
        let size = state.model().size() as f32;
        for hand in &held.0 {
            let (target, point) = (hand.target.as_vec3(), hand.point.as_vec3());
            gizmos.sphere(target, 0.02 * size, hand.color);
            gizmos.line(target, point, hand.color);
            let force = hand.force.as_vec3();
            if force.length() > 0.05 {
                // 50 N are drawn as long as the body; the length is limited to 0.4 of the body's
                // size.
                let arrow = (force * 0.02 * size).clamp_length_max(0.4 * size);
                gizmos.arrow(point, point + arrow, Color::srgb(0.85, 0.1, 0.15));
            }
        }
    }
}

fn write_metrics(metrics: Res<Metrics>, meters: Res<Meters>, mut readout: ResMut<Readout>) {
    if !metrics.joined {
        return;
    }
    let streamed = &meters.streamed;
    readout.0 = format!(
        "loss            {:6.1} %\n\
         round trip      {:6.0} ms\n\
         streamed error{:8.4} %\n\
         rms so far    {:8.4} %\n\
         prediction      {:6.0} ms\n\
         reaction        {:6.2} N\n\
         received        {:6.1} kbit/s",
        100.0 * metrics.loss,
        1e3 * metrics.round_trip,
        streamed.percent(streamed.now),
        streamed.percent(streamed.rms()),
        1e3 * metrics.ahead,
        metrics.reaction,
        metrics.kbit_s,
    );
}

/// A hand on the body, for drawing.
pub struct DrawnHand {
    pub target: bevy::math::DVec3,
    pub point: bevy::math::DVec3,
    pub force: bevy::math::DVec3,
    pub color: Color,
}

/// The hands on a body that this guest knows.
#[derive(Component, Default)]
pub struct HeldBy(pub Vec<DrawnHand>);

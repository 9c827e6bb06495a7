//! The window: the body as this guest sees it, the host's truth as a ghost, hands, and the figures in a corner.

use std::f32::consts::PI;

use bevy::{
    input::mouse::{AccumulatedMouseMotion, AccumulatedMouseScroll},
    light::{CascadeShadowConfigBuilder, NotShadowCaster, NotShadowReceiver},
    prelude::*,
};
use pliant::{prelude::*, rerun::RerunStyle};

use crate::{
    guest::{Figures, GuestBody},
    meter::{Meter, Truth},
};

/// The translucent body that shows the host's newest state, with no network between.
#[derive(Component)]
pub struct Ghost;

/// Shown ghost or not.
#[derive(Resource)]
struct GhostOn(bool);

#[derive(Component)]
struct Hud;

/// The camera goes round this.
#[derive(Resource)]
struct Orbit {
    middle: Vec3,
    distance: f32,
    yaw: f32,
    pitch: f32,
}

pub struct ViewPlugin;

impl Plugin for ViewPlugin {
    fn build(&self, app: &mut App) {
        app.insert_resource(ClearColor(Color::srgb(0.665, 0.695, 0.73)))
            .insert_resource(GhostOn(true))
            .add_systems(Startup, (set_scene, set_hud, set_gizmos))
            .add_systems(
                Update,
                (dress, ghost_follows, keys, orbit, draw_hands, write_hud, frame_body).chain(),
            );
    }
}

fn set_scene(
    mut commands: Commands,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.insert_resource(Orbit {
        middle: Vec3::new(0.0, 0.16, 0.0),
        distance: 0.85,
        yaw: 0.45,
        pitch: 0.22,
    });
    commands.spawn((
        Camera3d::default(),
        Transform::from_xyz(0.4, 0.35, 0.8).looking_at(Vec3::new(0.0, 0.16, 0.0), Vec3::Y),
        Msaa::Sample4,
        AmbientLight { color: Color::srgb(0.82, 0.88, 1.0), brightness: 450.0, ..default() },
        DistanceFog {
            color: Color::srgb(0.80, 0.85, 0.90),
            falloff: FogFalloff::Linear { start: 1.6, end: 4.5 },
            ..default()
        },
    ));
    commands.spawn((
        DirectionalLight {
            illuminance: 9_500.0,
            shadow_maps_enabled: true,
            color: Color::srgb(1.0, 0.95, 0.86),
            ..default()
        },
        Transform::from_rotation(Quat::from_euler(EulerRot::YXZ, 0.7, -0.95, 0.0)),
        CascadeShadowConfigBuilder { num_cascades: 1, maximum_distance: 2.5, ..default() }.build(),
    ));
    // A cool light from behind keeps the dark side readable.
    commands.spawn((
        DirectionalLight { illuminance: 1_800.0, color: Color::srgb(0.65, 0.78, 1.0), ..default() },
        Transform::from_rotation(Quat::from_euler(EulerRot::YXZ, PI + 0.6, -0.5, 0.0)),
    ));
    commands.spawn((
        Mesh3d(meshes.add(Plane3d::default().mesh().size(80.0, 80.0))),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.72, 0.74, 0.78),
            perceptual_roughness: 0.95,
            ..default()
        })),
    ));
}

/// Hands and forces are drawn over everything: a reaction points into the body.
fn set_gizmos(mut store: ResMut<GizmoConfigStore>) {
    let (config, _) = store.config_mut::<DefaultGizmoConfigGroup>();
    config.depth_bias = -1.0;
    config.line.width = 3.0;
}

fn set_hud(mut commands: Commands) {
    let panel = |top: Val, bottom: Val| {
        (
            Node {
                position_type: PositionType::Absolute,
                left: px(14),
                top,
                bottom,
                padding: UiRect::axes(px(12), px(8)),
                border_radius: BorderRadius::all(px(6)),
                ..default()
            },
            BackgroundColor(Color::srgba(0.06, 0.08, 0.11, 0.72)),
        )
    };
    let font = |size: f32| TextFont { font_size: FontSize::Px(size), ..default() };
    commands.spawn(panel(px(14), Val::Auto)).with_child((Text::new("joining ..."), font(15.0), Hud));
    commands.spawn(panel(Val::Auto, px(14))).with_child((
        Text::new("left mouse: pull the body    right mouse: look around    wheel: nearer, farther    G: ghost of the host's truth    Esc: end"),
        font(13.0),
        TextColor(Color::srgb(0.85, 0.88, 0.92)),
    ));
}

/// Gives the body its skin once it is here, and the ghost beside it.
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
                    // Where both agree the body is seen, not a mixture of the two.
                    depth_bias: -60_000.0,
                    ..default()
                })),
            ));
        }
    }
}

/// The ghost takes the host's newest state, without any network.
fn ghost_follows(
    truth: Res<Truth>,
    on: Res<GhostOn>,
    mut ghosts: Query<(&mut ShownState, &mut Visibility), With<Ghost>>,
) {
    for (mut shown, mut visibility) in &mut ghosts {
        visibility.set_if_neq(if on.0 { Visibility::Inherited } else { Visibility::Hidden });
        if let Some((_, q)) = truth.newest() {
            // Another number of modes for a moment, while the body changes: the ghost waits.
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

fn orbit(
    buttons: Res<ButtonInput<MouseButton>>,
    motion: Res<AccumulatedMouseMotion>,
    wheel: Res<AccumulatedMouseScroll>,
    mut orbit: ResMut<Orbit>,
    mut camera: Single<&mut Transform, With<Camera3d>>,
) {
    if buttons.pressed(MouseButton::Right) {
        orbit.yaw -= motion.delta.x * 0.006;
        orbit.pitch = (orbit.pitch + motion.delta.y * 0.006).clamp(-0.1, 1.4);
    }
    orbit.distance = (orbit.distance * (1.0 - 0.08 * wheel.delta.y.clamp(-3.0, 3.0))).clamp(0.3, 3.0);
    let back = Quat::from_euler(EulerRot::YXZ, orbit.yaw, -orbit.pitch, 0.0) * Vec3::Z;
    **camera =
        Transform::from_translation(orbit.middle + orbit.distance * back).looking_at(orbit.middle, Vec3::Y);
}

/// Looks at the body, however large it is.
fn frame_body(
    bodies: Query<(&BodyState, &GlobalTransform), (With<GuestBody>, Added<BodyState>)>,
    mut orbit: ResMut<Orbit>,
) {
    for (state, place) in &bodies {
        let [low, high] = state.model().surface().bounds();
        let middle = (Vec3::from(low) + Vec3::from(high)) / 2.0;
        orbit.middle = place.transform_point(middle);
        orbit.distance = 2.3 * state.model().size() as f32;
    }
}

/// Every hand as a ball at its target, a line to the patch it holds, and the reaction as an arrow.
fn draw_hands(mut gizmos: Gizmos, bodies: Query<(&HeldBy, &BodyState), With<GuestBody>>) {
    for (held, state) in &bodies {
        let size = state.model().size() as f32;
        for hand in &held.0 {
            let (target, point) = (hand.target.as_vec3(), hand.point.as_vec3());
            gizmos.sphere(target, 0.02 * size, hand.colour);
            gizmos.line(target, point, hand.colour);
            let force = hand.force.as_vec3();
            if force.length() > 0.05 {
                // Fifty newtons are a body's length; what is stronger is drawn no longer.
                let arrow = (force * 0.02 * size).clamp_length_max(0.4 * size);
                gizmos.arrow(point, point + arrow, Color::srgb(0.85, 0.1, 0.15));
            }
        }
    }
}

fn write_hud(figures: Res<Figures>, meter: Res<Meter>, mut hud: Single<&mut Text, With<Hud>>) {
    if !figures.joined {
        return;
    }
    hud.0 = format!(
        "{}\n\
         loss            {:6.1} %\n\
         round trip      {:6.0} ms\n\
         behind the host {:6.0} ms\n\
         error now     {:8.4} %\n\
         error rms     {:8.4} %\n\
         reaction        {:6.2} N\n\
         received        {:6.1} kbit/s",
        figures.title,
        100.0 * figures.loss,
        1e3 * figures.round_trip,
        1e3 * figures.behind,
        meter.percent(meter.now),
        meter.percent(meter.rms()),
        figures.reaction,
        figures.kbit_s,
    );
}

/// A hand on the body, for drawing.
pub struct DrawnHand {
    pub target: bevy::math::DVec3,
    pub point: bevy::math::DVec3,
    pub force: bevy::math::DVec3,
    pub colour: Color,
}

/// The hands on a body as this guest knows them.
#[derive(Component, Default)]
pub struct HeldBy(pub Vec<DrawnHand>);

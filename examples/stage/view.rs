//! Light, a floor, and a camera that orbits the scene.

use std::f32::consts::PI;

use bevy::{
    input::mouse::{AccumulatedMouseMotion, AccumulatedMouseScroll},
    light::CascadeShadowConfigBuilder,
    prelude::*,
};

/// Position of the camera, which orbits `middle`.
#[derive(Resource, Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Point that the camera looks at, m.
    pub middle: Vec3,
    /// Distance of the camera from that point, m; fog and shadows scale with it.
    pub distance: f32,
    /// Angle about the vertical, rad; 0 looks along -z.
    pub yaw: f32,
    /// Angle above the horizon, rad.
    pub pitch: f32,
}

impl Default for Look {
    fn default() -> Self {
        Self { middle: Vec3::new(0.0, 0.16, 0.0), distance: 0.85, yaw: 0.45, pitch: 0.22 }
    }
}

impl Look {
    fn place(&self) -> Transform {
        let back = Quat::from_euler(EulerRot::YXZ, self.yaw, -self.pitch, 0.0) * Vec3::Z;
        Transform::from_translation(self.middle + self.distance * back).looking_at(self.middle, Vec3::Y)
    }
}

/// Minimum and maximum distance for the wheel, m.
#[derive(Resource)]
struct Reach([f32; 2]);

#[derive(Component)]
struct Orbits;

pub(super) fn build(app: &mut App, look: Look, floor: bool) {
    app.insert_resource(ClearColor(Color::srgb(0.665, 0.695, 0.73)))
        .insert_resource(look)
        .insert_resource(Reach([0.3 * look.distance, 3.5 * look.distance]))
        .add_systems(Startup, (light, set_gizmos))
        .add_systems(Update, (orbit.run_if(super::scene_has_pointer), follow_look).chain());
    if floor {
        app.add_systems(Startup, lay_floor);
    }
}

fn light(mut commands: Commands, look: Res<Look>) {
    let d = look.distance;
    commands.spawn((
        Camera3d::default(),
        Orbits,
        look.place(),
        Msaa::Sample4,
        AmbientLight { color: Color::srgb(0.82, 0.88, 1.0), brightness: 450.0, ..default() },
        DistanceFog {
            color: Color::srgb(0.80, 0.85, 0.90),
            falloff: FogFalloff::Linear { start: 1.9 * d, end: 5.3 * d },
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
        CascadeShadowConfigBuilder { num_cascades: 1, maximum_distance: 2.9 * d, ..default() }.build(),
    ));
    // A cool light from behind keeps the dark side readable.
    commands.spawn((
        DirectionalLight { illuminance: 1_800.0, color: Color::srgb(0.65, 0.78, 1.0), ..default() },
        Transform::from_rotation(Quat::from_euler(EulerRot::YXZ, PI + 0.6, -0.5, 0.0)),
    ));
}

fn lay_floor(
    mut commands: Commands,
    look: Res<Look>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.spawn((
        Mesh3d(meshes.add(Plane3d::default().mesh().size(95.0 * look.distance, 95.0 * look.distance))),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.72, 0.74, 0.78),
            perceptual_roughness: 0.95,
            ..default()
        })),
    ));
}

/// Draws lines, such as hands and forces, over everything, because a reaction points into the body.
fn set_gizmos(mut store: ResMut<GizmoConfigStore>) {
    for (_, config, _) in store.iter_mut() {
        config.depth_bias = -1.0;
        config.line.width = 3.0;
    }
}

fn orbit(
    buttons: Res<ButtonInput<MouseButton>>,
    motion: Res<AccumulatedMouseMotion>,
    wheel: Res<AccumulatedMouseScroll>,
    reach: Res<Reach>,
    mut look: ResMut<Look>,
) {
    if buttons.pressed(MouseButton::Right) && motion.delta != Vec2::ZERO {
        look.yaw -= motion.delta.x * 0.006;
        look.pitch = (look.pitch + motion.delta.y * 0.006).clamp(-0.1, 1.4);
    }
    if wheel.delta.y != 0.0 {
        let nearer = 1.0 - 0.08 * wheel.delta.y.clamp(-3.0, 3.0);
        look.distance = (look.distance * nearer).clamp(reach.0[0], reach.0[1]);
    }
}

fn follow_look(look: Res<Look>, mut camera: Single<&mut Transform, With<Orbits>>) {
    if look.is_changed() {
        **camera = look.place();
    }
}

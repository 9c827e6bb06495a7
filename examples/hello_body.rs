//! The smallest example: a plugin group, a body, a material, a light and a camera.
//!
//! What to learn here: a body is one component, [`ModalBody`]. A `MeshMaterial3d` beside it draws
//! the body. The body bends and comes to rest, and the pointer drags it, without more code.
//!
//! ```sh
//! cargo run --release --example hello_body
//! ```

mod stage;

use bevy::prelude::*;
use pliant::prelude::*;

fn main() -> AppExit {
    App::new()
        // A game adds `DefaultPlugins` here. The stage adds the keys on the screen and the command
        // line of the examples.
        .add_plugins(stage::Stage::new("hello, body").bare().key("left mouse: pull the body"))
        .add_plugins(PliantPlugins::default())
        .add_systems(Startup, setup)
        .run()
}

fn setup(mut commands: Commands, assets: Res<AssetServer>, mut materials: ResMut<Assets<StandardMaterial>>) {
    commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        MeshMaterial3d(materials.add(Color::srgb(0.95, 0.50, 0.36))),
    ));
    commands.spawn((
        DirectionalLight { shadow_maps_enabled: true, ..default() },
        Transform::from_xyz(2.0, 4.0, 3.0).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    commands
        .spawn((Camera3d::default(), Transform::from_xyz(0.3, 0.3, 0.7).looking_at(Vec3::Y * 0.14, Vec3::Y)));
}

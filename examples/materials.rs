//! Three jellies of one shape that are pulled alike: soft and firm with a texture, soft with a
//! shader.
//!
//! What to learn here: the deformed surface is an ordinary mesh, so every material works on it. A
//! texture stays where it was painted. A shader for Bevy's `Material` needs no knowledge of bodies.
//! The stiffness comes from the material that was baked.
//!
//! ```sh
//! cargo run --release --example materials
//! cargo run --release --example materials -- --bake    # nothing baked is loaded: the jellies are baked while the window is open
//! ```

mod stage;

use bevy::{
    math::DVec3,
    pbr::{ExtendedMaterial, MaterialExtension},
    prelude::*,
    reflect::TypePath,
    render::render_resource::AsBindGroup,
    shader::ShaderRef,
};
use clap::Parser;
use pliant::{
    bake::BakeConfig,
    body::{BakePlugin, BakeProgress, BakeRequest, BakeSkin},
    modal::Damping,
    prelude::*,
};
use stage::{Look, Readout, Stage};

#[derive(Parser)]
struct Options {
    /// Bake the jellies from their surface at start, instead of loading baked models.
    #[arg(long)]
    bake: bool,
    #[command(flatten)]
    stage: stage::Options,
}

fn main() -> AppExit {
    let options = Options::parse();
    App::new()
        .add_plugins(
            Stage::with("materials", options.stage)
                .key("left mouse: pull a jelly")
                .look(Look { middle: Vec3::new(0.0, 0.05, 0.0), distance: 0.60, yaw: 0.0, pitch: 0.34 })
                .picture_at(2.1),
        )
        .add_plugins((PliantPlugins::default(), MaterialPlugin::<Glowing>::default(), BakePlugin::default()))
        .insert_resource(Source { bake: options.bake })
        .add_systems(Startup, spawn)
        .add_systems(FixedUpdate, (take_hold, pull).chain().before(PliantSystems::Input))
        .add_systems(Update, write)
        .run()
}

/// The source of the jellies.
#[derive(Resource)]
struct Source {
    bake: bool,
}

/// Bevy's standard material with light added on top.
type Glowing = ExtendedMaterial<StandardMaterial, Bands>;

/// Bands of light along the texture's second coordinate; the layout matches `shaders/bands.wgsl`.
#[derive(Asset, AsBindGroup, TypePath, Clone, Debug)]
struct Bands {
    #[uniform(100)]
    glow: LinearRgba,
    /// Number of bands.
    #[uniform(100)]
    count: f32,
    /// Speed of the bands, bands per second.
    #[uniform(100)]
    speed: f32,
}

impl MaterialExtension for Bands {
    fn fragment_shader() -> ShaderRef {
        "shaders/bands.wgsl".into()
    }
}

fn spawn(
    mut commands: Commands,
    source: Res<Source>,
    assets: Res<AssetServer>,
    mut standard: ResMut<Assets<StandardMaterial>>,
    mut glowing: ResMut<Assets<Glowing>>,
) {
    let textured = standard.add(StandardMaterial {
        base_color_texture: Some(assets.load("jelly.png")),
        perceptual_roughness: 0.3,
        clearcoat: 0.6,
        ..default()
    });
    let glow = glowing.add(Glowing {
        base: StandardMaterial { perceptual_roughness: 0.35, ..Color::srgb(0.16, 0.24, 0.42).into() },
        extension: Bands { glow: LinearRgba::rgb(0.25, 0.85, 0.75), count: 9.0, speed: 0.4 },
    });
    let skins = [Skin::Textured(textured.clone()), Skin::Textured(textured), Skin::Glowing(glow)];
    let names = ["soft, texture", "firm, texture", "soft, own shader"];
    for (i, (skin, name)) in skins.into_iter().zip(names).enumerate() {
        let firm = i == 1;
        let mut body = ModalBody::default();
        body.settings.gravity = [0.0, -9.81, 0.0];
        if !source.bake {
            body.model = assets.load(if firm { "jelly-firm.modal" } else { "jelly-soft.modal" });
        }
        let place = Transform::from_xyz(0.24 * (i as f32 - 1.0), 0.0, 0.0);
        let mut jelly = commands.spawn((Name::new(name), body, place));
        match skin {
            Skin::Textured(material) => jelly.insert(MeshMaterial3d(material)),
            Skin::Glowing(material) => jelly.insert(MeshMaterial3d(material)),
        };
        if source.bake {
            jelly.insert(baked(if firm { 4e4 } else { 4e3 }));
        }
    }
}

enum Skin {
    Textured(Handle<StandardMaterial>),
    Glowing(Handle<Glowing>),
}

/// Returns a request to bake a jelly in the game; its surface is filled and is also the skin.
fn baked(young: f64) -> BakeRequest {
    BakeRequest {
        tets: 3_000,
        skin: BakeSkin::Shape,
        config: BakeConfig {
            name: "jelly".into(),
            young,
            poisson: 0.45,
            damping: Damping::Ratio(0.05),
            anchors: "y<0.004".parse().into_iter().collect(),
            sites: Some(32),
            ..default()
        },
        ..BakeRequest::file(format!("{}/jelly.obj", stage::ASSETS))
    }
}

/// A scripted hand, and the point where it took hold.
#[derive(Component)]
struct Hand(DVec3);

/// Grabs the top of each jelly with a soft spring, so that all are pulled with similar forces.
fn take_hold(
    mut commands: Commands,
    bodies: Query<(Entity, &BodyState, &GlobalTransform), Added<BodyState>>,
) {
    for (body, state, place) in &bodies {
        let positions = state.model().surface().positions();
        let top =
            (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap_or(0);
        let at = place.transform_point(Vec3::from(positions[top])).as_dvec3();
        let grab = Grab { stiffness: Some(20.0), ..Grab::new(top as u32, 0.035, at) };
        commands.spawn((grab, GrabOf(body), Hand(at)));
    }
}

/// Moves the hands back and forth.
fn pull(time: Res<Time>, mut hands: Query<(&Hand, &mut Grab)>) {
    let t = time.elapsed_secs_f64();
    let reach = 0.20 * (t / 0.6).min(1.0);
    for (hand, mut grab) in &mut hands {
        grab.target = hand.0 + reach * DVec3::new((1.5 * t).sin(), 0.15, (0.9 * t).sin() * 0.4);
    }
}

fn write(
    bodies: Query<(&Name, &BodyState, &Grabs)>,
    bakes: Query<(&Name, &BakeProgress)>,
    forces: Query<(&GrabForce, &Hand)>,
    mut readout: ResMut<Readout>,
) {
    let mut text = String::new();
    for (name, state, grabs) in bodies.iter().sort::<&Name>() {
        for (felt, hand) in forces.iter_many(grabs.entities()) {
            text += &format!(
                "{:18} E {:5.0} kPa   pulled by {:4.2} N   bent by {:5.1} mm\n",
                name.as_str(),
                1e-3 * state.model().info().young,
                felt.force.length(),
                1e3 * (felt.point - hand.0).length(),
            );
        }
    }
    for (name, progress) in bakes.iter().sort::<&Name>() {
        text += &match progress {
            BakeProgress::Waiting => format!("{:18} waits to be baked\n", name.as_str()),
            BakeProgress::Running { stage, share } => {
                format!("{:18} {stage:?} {:3.0} %\n", name.as_str(), 100.0 * share)
            }
            BakeProgress::Done { cached: true, .. } => format!("{:18} was baked before\n", name.as_str()),
            BakeProgress::Done { seconds, .. } => {
                format!("{:18} baked in {seconds:.1} s\n", name.as_str())
            }
            BakeProgress::Failed { reason } => format!("{:18} {reason}\n", name.as_str()),
        };
    }
    readout.0 = text;
}

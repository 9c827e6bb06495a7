//! The ten scenes: their plugins, their content and their work.

use std::{error::Error, path::Path, sync::Arc};

#[cfg(feature = "window")]
use bevy::{
    camera::RenderTarget, log::LogPlugin, render::RenderPlugin, render::render_resource::TextureFormat,
    render::settings::WgpuSettings, window::ExitCondition, winit::WinitPlugin,
};
use bevy::{math::DVec3, prelude::*};
use clap::ValueEnum;
use pliant::{modal::ModalModel, prelude::*};

use crate::HZ;
#[cfg(feature = "net")]
use crate::partner::Partner;

/// A typical scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Scene {
    /// The engine of a game with a window, and nothing of Pliant (`window`).
    Engine,
    /// The engine without rendering, and nothing of Pliant (no feature).
    Bare,
    /// One body that is pulled and rendered (`window`).
    Solo,
    /// A thousand bodies of one model (`window`).
    Many,
    /// A thousand bodies of one model, without rendering (no feature).
    Crowd,
    /// A thousand bodies of 30 modes, each held by a hand, without rendering (no feature).
    Held,
    /// A server of one body with one guest, without rendering (`net`).
    Host,
    /// A guest that renders and holds the host's body (`window`, `net`).
    Guest,
    /// One body with a haptic device on its own 1 kHz loop (`window`, `haptics`).
    Haptics,
    /// All features: a host with rendering, haptics, recording and baking.
    Everything,
}

impl Scene {
    pub fn name(self) -> String {
        format!("{self:?}").to_lowercase()
    }
}

/// True while the scene is at work. Otherwise no hand touches a body.
#[derive(Resource, Default)]
pub struct Work(pub bool);

/// Resources that must live beside the app while it is measured.
#[derive(Default)]
pub struct Company {
    #[cfg(feature = "net")]
    partner: Option<Partner>,
    #[cfg(feature = "rerun")]
    recording: Option<std::path::PathBuf>,
    #[cfg(feature = "haptics")]
    hand: Option<pliant::haptics::VirtualHandle>,
}

#[cfg(feature = "rerun")]
impl Drop for Company {
    fn drop(&mut self) {
        if let Some(file) = &self.recording {
            // The recording may never have been written.
            let _ = std::fs::remove_file(file);
        }
    }
}

/// Adds the engine's plugins: those of a windowed game without its window, or the minimum for
/// bodies.
pub fn engine(app: &mut App) {
    #[cfg(feature = "window")]
    app.add_plugins(
        DefaultPlugins
            .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
            .set(RenderPlugin {
                render_creation: WgpuSettings { backends: None, ..default() }.into(),
                ..default()
            })
            .disable::<LogPlugin>()
            .disable::<WinitPlugin>(),
    );
    #[cfg(not(feature = "window"))]
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin::default(),
        TransformPlugin,
        bevy::diagnostic::DiagnosticsPlugin,
    ));
    app.insert_resource(Time::<Fixed>::from_hz(HZ)).init_resource::<Work>();
}

fn missing(scene: Scene, features: &str) -> Box<dyn Error> {
    format!("{scene:?} needs the features {features}").into()
}

/// Adds exactly the plugins that a scene needs.
pub fn plugins(scene: Scene, app: &mut App) -> Result<Company, Box<dyn Error>> {
    let mut company = Company::default();
    // The features decide which fields exist, so `company` may stay unused.
    let _ = &mut company;
    let seen = !matches!(scene, Scene::Bare | Scene::Host | Scene::Crowd | Scene::Held);
    if seen && !cfg!(feature = "window") {
        return Err(missing(scene, "window"));
    }
    match scene {
        Scene::Engine | Scene::Bare => return Ok(company),
        Scene::Host | Scene::Crowd | Scene::Held => app.add_plugins(PliantBodyPlugin::default()),
        _ => app.add_plugins(PliantPlugins::default()),
    };
    if matches!(scene, Scene::Host | Scene::Guest | Scene::Everything) {
        #[cfg(feature = "net")]
        {
            let (partner, net) = if scene == Scene::Guest { Partner::host()? } else { Partner::guest()? };
            app.add_plugins(net);
            company.partner = Some(partner);
        }
        #[cfg(not(feature = "net"))]
        return Err(missing(scene, "net"));
    }
    if matches!(scene, Scene::Haptics | Scene::Everything) {
        #[cfg(feature = "haptics")]
        app.add_plugins(pliant::haptics::HapticsPlugin::default());
        #[cfg(not(feature = "haptics"))]
        return Err(missing(scene, "haptics"));
    }
    if scene == Scene::Everything {
        #[cfg(all(feature = "rerun", feature = "bake"))]
        {
            let file = std::env::temp_dir().join(format!("leave-out-{}.rrd", std::process::id()));
            app.add_plugins((pliant::rerun::RerunPlugin::file(&file), pliant::body::BakePlugin::default()));
            company.recording = Some(file);
        }
        #[cfg(not(all(feature = "rerun", feature = "bake")))]
        return Err(missing(scene, "rerun, bake"));
    }
    Ok(company)
}

pub fn model(name: &str) -> Result<Arc<ModalModel>, Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets").join(name);
    Ok(Arc::new(ModalModel::read(path)?))
}

/// The vertex farthest to the right and up: an ear of the shipped body.
pub fn ear(model: &ModalModel) -> u32 {
    let positions = model.surface().positions();
    let far = |v: &usize| f64::from(positions[*v][0]) + 0.55 * f64::from(positions[*v][1]);
    (0..positions.len()).max_by(|a, b| far(a).total_cmp(&far(b))).unwrap_or(0) as u32
}

/// Spawns the content of a scene.
pub fn spawn(scene: Scene, app: &mut App, company: &mut Company) -> Result<(), Box<dyn Error>> {
    if matches!(scene, Scene::Engine | Scene::Bare) {
        #[cfg(feature = "window")]
        look(app);
        return Ok(());
    }
    let pip = model("pip.modal")?;
    let side = ear(&pip);
    let place = Vec3::from(pip.surface().positions()[side as usize]);
    let mut add = |model: Arc<ModalModel>| {
        app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model))
    };
    match scene {
        Scene::Many | Scene::Crowd => {
            let bud = add(model("bud.modal")?);
            for i in 0..1_000 {
                app.world_mut().spawn((ModalBody::new(bud.clone()), in_rows(i)));
            }
            app.add_systems(FixedUpdate, shake.before(PliantSystems::Input));
        }
        Scene::Held => {
            let handle = add(pip.clone());
            for i in 0..1_000 {
                app.world_mut().spawn((ModalBody::new(handle.clone()), in_rows(i)));
            }
            app.insert_resource(Hand { vertex: side, from: place.as_dvec3(), grab: None });
            app.add_systems(FixedUpdate, pull_all.before(PliantSystems::Input));
        }
        Scene::Guest => {
            #[cfg(feature = "net")]
            app.world_mut().spawn((pliant::net::SharedBody::named("pip"), Transform::default()));
        }
        _ => {
            let handle = add(pip.clone());
            let body = app.world_mut().spawn(ModalBody::new(handle)).id();
            #[cfg(feature = "net")]
            if matches!(scene, Scene::Host | Scene::Everything) {
                app.world_mut().entity_mut(body).insert(pliant::net::SharedBody::named("pip"));
            }
            let _ = body;
        }
    }
    if matches!(scene, Scene::Solo | Scene::Host | Scene::Guest | Scene::Everything) {
        app.insert_resource(Hand { vertex: side, from: place.as_dvec3(), grab: None });
        app.add_systems(FixedUpdate, pull.before(PliantSystems::Input));
    }
    #[cfg(feature = "haptics")]
    if matches!(scene, Scene::Haptics | Scene::Everything) {
        feel(app, company, place)?;
    }
    let _ = company;
    #[cfg(feature = "window")]
    look(app);
    Ok(())
}

fn in_rows(i: u32) -> Transform {
    Transform::from_xyz(0.22 * (i % 32) as f32 - 3.4, 0.0, 0.22 * (i / 32) as f32 - 3.4)
}

/// Adds a camera, because bodies that no camera sees are not deformed.
#[cfg(feature = "window")]
fn look(app: &mut App) {
    let canvas = Image::new_target_texture(1280, 720, TextureFormat::Rgba8UnormSrgb, None);
    let canvas = app.world_mut().resource_mut::<Assets<Image>>().add(canvas);
    let eye = Transform::from_xyz(0.0, 6.0, 9.0).looking_at(Vec3::ZERO, Vec3::Y);
    app.world_mut().spawn((Camera3d::default(), RenderTarget::from(canvas), eye));
}

/// A hand that moves the ear while there is work.
#[derive(Resource)]
struct Hand {
    vertex: u32,
    from: DVec3,
    grab: Option<Entity>,
}

fn pull(
    mut commands: Commands,
    work: Res<Work>,
    time: Res<Time>,
    mut hand: ResMut<Hand>,
    bodies: Query<Entity, With<BodyState>>,
    mut grabs: Query<&mut Grab>,
) {
    if !work.0 {
        return;
    }
    let t = time.elapsed_secs_f64();
    let target = hand.from + 0.04 * DVec3::new((3.0 * t).sin(), 0.5 * (4.1 * t).sin(), (2.3 * t).cos() - 1.0);
    match hand.grab.and_then(|grab| grabs.get_mut(grab).ok()) {
        Some(mut grab) => grab.target = target,
        None => {
            let Some(body) = bodies.iter().next() else { return };
            hand.grab = Some(commands.spawn((Grab::new(hand.vertex, 0.02, target), GrabOf(body))).id());
        }
    }
}

/// A hand at every body, while there is work.
fn pull_all(
    mut commands: Commands,
    work: Res<Work>,
    time: Res<Time>,
    hand: Res<Hand>,
    bodies: Query<(Entity, &GlobalTransform), With<BodyState>>,
    mut grabs: Query<(&mut Grab, &GrabOf)>,
) {
    if !work.0 {
        return;
    }
    let t = time.elapsed_secs_f64();
    let way = 0.04 * DVec3::new((3.0 * t).sin(), 0.5 * (4.1 * t).sin(), (2.3 * t).cos() - 1.0);
    let target = |place: &GlobalTransform| place.translation().as_dvec3() + hand.from + way;
    if grabs.is_empty() {
        for (body, place) in &bodies {
            commands.spawn((Grab::new(hand.vertex, 0.02, target(place)), GrabOf(body)));
        }
    }
    for (mut grab, of) in &mut grabs {
        if let Ok((_, place)) = bodies.get(of.0) {
            grab.target = target(place);
        }
    }
}

/// Applies an impulse to every body ten times a second, so that none rests.
fn shake(
    work: Res<Work>,
    mut tick: Local<u32>,
    mut vertex: Local<Option<u32>>,
    bodies: Query<(Entity, &BodyState)>,
    mut blows: MessageWriter<Impulse>,
) {
    *tick += 1;
    if work.0 && tick.is_multiple_of(6) {
        blows.write_batch(bodies.iter().map(|(body, state)| Impulse {
            body,
            vertex: *vertex.get_or_insert_with(|| ear(state.model())),
            impulse: DVec3::new(1e-3, 0.0, 5e-4),
        }));
    }
}

/// Adds a simulated device at the ear. Its hand presses the button and moves while there is work.
#[cfg(feature = "haptics")]
fn feel(app: &mut App, company: &mut Company, place: Vec3) -> Result<(), Box<dyn Error>> {
    use pliant::haptics::{HandModel as Grip, LoopConfig, VirtualConfig, VirtualDevice};

    let device = VirtualDevice::new(VirtualConfig::premium(), Grip::FIRM)?;
    let hand = device.handle();
    let device = app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default())?;
    app.world_mut().spawn((HapticTool::new(device), ToolGrip::default(), Transform::from_translation(place)));
    company.hand = Some(hand.clone());
    app.add_systems(FixedUpdate, move |work: Res<Work>, time: Res<Time>| {
        hand.set_buttons(u32::from(work.0));
        if work.0 {
            let t = time.elapsed_secs_f64();
            hand.set_target([0.02 * (3.0 * t).sin(), 0.01 * (4.1 * t).sin(), 0.0]);
        }
    });
    Ok(())
}

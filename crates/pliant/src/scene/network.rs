//! The session that a scene asks for, and the optional guest beside its host.

use std::{
    collections::HashMap,
    fmt::Display,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use bevy::{app::ScheduleRunnerPlugin, math::DVec3, prelude::*};

use super::locate::Step::Field;
use super::plugin::{AssetRoot, SceneFilePlugin};
use super::spawn::{PartOf, SceneBody};
use super::{GuestEntry, NetworkEntry, SceneError, SceneErrorKind, SceneFile};
use crate::body::{BodyState, Driven, ModalBody, NoPointerGrab, PliantBodyPlugin, Pose, VisualState};
use crate::modal::ModalModel;
use crate::net::{
    Access, Emulation, Grant, HostConfig, HostOptions, Invite, JoinConfig, JoinOptions, NetPlugin,
    PeerConfig, Token,
};
use crate::stream::emulator::Preset;

/// A session whose socket is open.
pub(super) struct Opened {
    pub(super) net: NetPlugin,
    guest: Option<GuestEntry>,
}

fn emulation(link: &Option<String>, seed: u64) -> Option<Emulation> {
    Some(Emulation::preset(Preset::by_name(link.as_deref()?)?, seed))
}

/// Returns the options of a host's or a peer's socket.
///
/// An address that other machines can reach accepts only guests with the invite's token.
fn options(
    listen: &Option<String>,
    link: &Option<String>,
) -> Result<HostOptions, Box<dyn std::error::Error>> {
    let mut options = HostOptions { emulation: emulation(link, 0), ..default() };
    if let Some(listen) = listen {
        options.bind = listen.parse()?;
        if !options.bind.ip().is_loopback() {
            options.access = Access::Tokens(vec![Grant::hold(Token::generate()?)]);
        }
    }
    Ok(options)
}

pub(super) fn open(file: &SceneFile, entry: &NetworkEntry) -> Result<Opened, SceneError> {
    let failed = |error: &dyn Display| {
        let message = format!("the session cannot be opened: {error}");
        file.error(&[Field("network")], SceneErrorKind::Open, message)
    };
    let invited = |invite: &str| invite.parse::<Invite>().map_err(|error| failed(&error));
    let (net, guest) = match entry {
        NetworkEntry::Host { name, listen, link, guest } => {
            let transport = options(listen, link).map_err(|error| failed(&error))?;
            let config = HostConfig { name: name.clone(), transport, ..default() };
            (NetPlugin::host(config), guest.clone())
        }
        NetworkEntry::Join { invite, name, link } => {
            let transport = JoinOptions { emulation: emulation(link, 1), ..default() };
            (
                NetPlugin::join(&invited(invite)?, JoinConfig { name: name.clone(), transport, ..default() }),
                None,
            )
        }
        NetworkEntry::Peer { invite, name, listen, link } => {
            let transport = options(listen, link).map_err(|error| failed(&error))?;
            let join = invite.as_deref().map(invited).transpose()?;
            (NetPlugin::peer(PeerConfig { name: name.clone(), join, transport, ..default() }), None)
        }
    };
    Ok(Opened { net: net.map_err(|error| failed(&error))?, guest })
}

/// The visual state of the guest: the modal coordinates, and the pose of a free body, per body
/// name.
#[derive(Resource, Clone, Default)]
struct LastStates(Arc<Mutex<HashMap<String, (Vec<f64>, Option<Pose>)>>>);

/// The thread of the guest beside the host, which ends with the app.
#[derive(Resource)]
struct GuestThread {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for GuestThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the guest of the scene stopped by a panic");
        }
    }
}

pub(super) fn build(app: &mut App, opened: Opened, file: &SceneFile) {
    let invite = opened.net.invite().cloned();
    app.add_plugins(opened.net);
    let (Some(guest), Some(invite)) = (opened.guest, invite) else { return };
    let root = app.world().get_resource::<AssetRoot>().map(|root| root.0.clone()).unwrap_or_default();
    let (seen, stop) = (LastStates::default(), Arc::new(AtomicBool::new(false)));
    let run = {
        let (file, seen, stop) = (file.clone(), seen.clone(), stop.clone());
        move || {
            if let Err(error) = run_guest(&invite, guest, &file, &root, seen, stop) {
                error!("{}: the guest of the scene cannot join: {error}", file.origin());
            }
        }
    };
    match thread::Builder::new().name("scene guest".into()).spawn(run) {
        Ok(thread) => app.insert_resource(GuestThread { stop, thread: Some(thread) }),
        Err(error) => {
            error!("{}: there is no thread for the guest of the scene: {error}", file.origin());
            return;
        }
    };
    app.insert_resource(seen).add_systems(Update, (lend, show));
}

/// Runs the guest's app on its own thread.
fn run_guest(
    invite: &Invite,
    guest: GuestEntry,
    file: &SceneFile,
    root: &Path,
    seen: LastStates,
    stop: Arc<AtomicBool>,
) -> Result<(), crate::net::NetError> {
    let transport = JoinOptions { emulation: emulation(&guest.link, guest.seed), ..default() };
    // The model is the largest transfer over a poor network, so the guest reads it from the disk.
    // The host sends a model that cannot be read here.
    let mut paths: Vec<PathBuf> =
        file.scene().bodies.iter().filter_map(|body| Some(root.join(body.model.as_ref()?))).collect();
    paths.sort();
    paths.dedup();
    let models = paths.into_iter().filter_map(|path| ModalModel::read(path).ok()).map(Arc::new).collect();
    let net = NetPlugin::join(invite, JoinConfig { name: guest.name, transport, models, ..default() })?;
    App::new()
        .add_plugins((
            MinimalPlugins.set(ScheduleRunnerPlugin::run_loop(Duration::from_millis(4))),
            AssetPlugin { file_path: root.display().to_string(), ..default() },
            TransformPlugin,
            PliantBodyPlugin::default(),
            net,
            SceneFilePlugin::guest(file.clone()),
        ))
        .insert_resource(seen)
        .add_systems(Last, move |mut exit: MessageWriter<AppExit>| {
            if stop.load(Ordering::Relaxed) {
                exit.write(AppExit::Success);
            }
        })
        .add_systems(Last, publish_states)
        .run();
    Ok(())
}

/// Publishes the visual states of the guest; runs in the guest's app.
fn publish_states(
    seen: Res<LastStates>,
    bodies: Query<(&Name, &VisualState, &BodyState, &Transform), With<SceneBody>>,
) {
    let mut seen = seen.0.lock().unwrap_or_else(PoisonError::into_inner);
    for (name, visual, state, place) in &bodies {
        let free = state
            .model()
            .is_free()
            .then(|| Pose { origin: place.translation.as_dvec3(), orientation: place.rotation.as_dquat() });
        let entry = seen.entry(name.as_str().to_owned()).or_default();
        entry.0.clear();
        entry.0.extend_from_slice(visual.q());
        entry.1 = free;
    }
}

/// A body of the host's app that shows the guest's visual state.
#[derive(Component)]
pub(super) struct GuestsView {
    name: String,
    beside: DVec3,
    settings: ModalBody,
    /// The last shown pose of a free body.
    pose: Option<Pose>,
}

/// Spawns the views of the guest's bodies in the host's app.
pub(super) fn spawn_views(world: &mut World, instance: Entity, file: &SceneFile, place: GlobalTransform) {
    let scene = file.scene();
    let Some(NetworkEntry::Host { guest: Some(guest), .. }) = &scene.network else { return };
    for body in scene.bodies.iter().filter(|body| body.shared.unwrap_or(true)) {
        for copy in 0..body.count() {
            let mut transform = place.mul_transform(body.transform(copy)).compute_transform();
            let beside = place.affine().transform_vector3(DVec3::from(guest.beside).as_vec3());
            transform.translation += beside;
            let name = body.name_of(copy);
            let view = world
                .spawn((
                    Name::new(format!("{name} ({})", guest.name)),
                    GuestsView { name, beside: beside.as_dvec3(), settings: body.modal(), pose: None },
                    Driven::Remote,
                    NoPointerGrab,
                    transform,
                    PartOf(instance),
                ))
                .id();
            #[cfg(feature = "render")]
            if let Some(mut materials) = world.get_resource_mut::<Assets<StandardMaterial>>() {
                // A cooler shade of the same color distinguishes the guest's view from the host's
                // body.
                let [r, g, b] = body.color.map(|part| part as f32);
                let material = materials.add(StandardMaterial {
                    base_color: Color::srgb(0.45 * r + 0.05, 0.45 * g + 0.20, 0.45 * b + 0.45),
                    perceptual_roughness: body.roughness as f32,
                    ..default()
                });
                world.entity_mut(view).insert(MeshMaterial3d(material));
            }
            #[cfg(not(feature = "render"))]
            let _ = view;
        }
    }
}

/// Gives each view of the guest the host's model, loaded or baked, once the host's body has it.
fn lend(
    mut commands: Commands,
    bodies: Query<(&Name, &PartOf, &ModalBody), (With<SceneBody>, Added<BodyState>)>,
    views: Query<(Entity, &GuestsView, &PartOf), Without<ModalBody>>,
) {
    for (name, part, body) in &bodies {
        for (entity, view, _) in views.iter().filter(|(_, view, of)| of.0 == part.0 && view.name == **name) {
            commands.entity(entity).insert(ModalBody { model: body.model.clone(), ..view.settings.clone() });
        }
    }
}

fn show(seen: Res<LastStates>, mut views: Query<(&mut GuestsView, &mut VisualState)>) {
    let seen = seen.0.lock().unwrap_or_else(PoisonError::into_inner);
    for (mut view, mut visual) in &mut views {
        let Some((q, pose)) = seen.get(&view.name).filter(|(q, _)| q.len() == visual.q().len()) else {
            continue;
        };
        // A resting body must not be drawn, uploaded and recorded again.
        if visual.current() == q.as_slice() && view.pose == *pose {
            continue;
        }
        view.pose = *pose;
        let written = match pose {
            None => visual.snap(q),
            Some(pose) => visual.push_at(q, Pose { origin: pose.origin + view.beside, ..*pose }),
        };
        if let Err(error) = written {
            warn_once!("{error}");
        }
    }
}

//! Spawns the entities of a scene: bodies, hands and tools.

use bevy::{asset::AssetLoadFailedEvent, math::DVec3, prelude::*};

use super::locate::Step::{self, Field, Item};
use super::needs::compiled;
#[cfg(feature = "bake")]
use super::plugin::AssetRoot;
use super::plugin::NetworkRole;
use super::{BodyEntry, By, NetworkEntry, SceneError, SceneErrorKind, SceneFile, TransformEntry};
use crate::body::{BodyRefused, BodyState, ModalAsset, ModalBody, NoPointerGrab};

/// A scene in the world.
///
/// Spawn this component, and the bodies, hands and tools of the scene are spawned at the transform
/// of this entity once the file is loaded. They are its [`SceneParts`] and are despawned with it.
/// When the file changes (Bevy's `file_watcher`), all parts are despawned and spawned again.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant::scene::SceneInstance;
/// fn setup(mut commands: Commands, assets: Res<AssetServer>) {
///     commands.spawn((SceneInstance(assets.load("scenes/solo.ron")), Transform::from_xyz(2.0, 0.0, 0.0)));
/// }
/// ```
#[derive(Component, Debug, Clone)]
#[require(Transform, Visibility, SceneClock)]
pub struct SceneInstance(pub Handle<SceneFile>);

/// The clock of a [`SceneInstance`]'s scripts, which starts when all bodies of the scene exist.
#[derive(Component, Debug, Default, Clone, Copy, PartialEq)]
pub struct SceneClock {
    pub(super) began: Option<f64>,
}

impl SceneClock {
    /// Returns the seconds between the start of the clock and `now`.
    ///
    /// `now` is the elapsed time of the schedule in which the bodies are stepped. The result is
    /// `None` until all bodies exist.
    pub fn at(&self, now: f64) -> Option<f64> {
        self.began.map(|began| (now - began).max(0.0))
    }
}

/// The [`SceneInstance`] that an entity belongs to.
#[derive(Component, Debug, Clone, Copy, PartialEq, Eq)]
#[relationship(relationship_target = SceneParts)]
pub struct PartOf(#[entities] pub Entity);

/// The entities that a [`SceneInstance`] has spawned; they are despawned with it.
#[derive(Component, Debug, Default)]
#[relationship_target(relationship = PartOf, linked_spawn)]
pub struct SceneParts(Vec<Entity>);

impl SceneParts {
    /// Returns the entities: bodies, hands and tools.
    pub fn entities(&self) -> &[Entity] {
        &self.0
    }
}

/// A body of a scene. Its `Name` is the name of the entry.
#[derive(Component, Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneBody {
    /// Index of the body's entry in [`SceneDescription::bodies`](super::SceneDescription::bodies).
    pub entry: usize,
}

/// A part of a scene that failed; sent as a message and logged.
///
/// The cause is a scene that cannot be read, a missing file or object that the scene names, or a
/// feature that the app lacks. The other bodies and the hands on them are not affected.
#[derive(Message, Debug, Clone)]
pub struct SceneFailed {
    /// The entity of the [`SceneInstance`].
    pub instance: Entity,
    /// The position in the file and what was expected.
    pub error: SceneError,
}

/// The file and the path of the entry that a part was made from, for the position of errors.
#[derive(Component, Debug, Clone)]
pub(super) struct SceneSource {
    pub(super) file: SceneFile,
    pub(super) path: Vec<Step>,
}

/// Keeps the model of a body that the host will send loaded, so that the host need not send the
/// model.
#[derive(Component)]
#[expect(dead_code, reason = "held, so that the asset stays")]
struct KeptEntry(Handle<ModalAsset>);

/// Marks an instance whose parts were spawned.
#[derive(Component)]
pub(super) struct Made;

/// Marks a body that failed to load or bake, so that the scene's clock does not wait for it.
#[derive(Component)]
pub(super) struct Lost;

pub(super) fn fail(world: &mut World, instance: Entity, error: SceneError) {
    error!("{error}");
    world.write_message(SceneFailed { instance, error });
}

/// Builds the instances whose file was loaded or has changed.
pub(super) fn make(
    mut commands: Commands,
    mut changes: MessageReader<AssetEvent<SceneFile>>,
    instances: Query<(Entity, &SceneInstance, Has<Made>)>,
    files: Res<Assets<SceneFile>>,
) {
    let changed: Vec<AssetId<SceneFile>> = changes
        .read()
        .filter_map(|event| if let AssetEvent::Modified { id } = event { Some(*id) } else { None })
        .collect();
    for (instance, handle, made) in &instances {
        if made && !changed.contains(&handle.0.id()) {
            continue;
        }
        let Some(file) = files.get(&handle.0) else { continue };
        let file = file.clone();
        commands.queue(move |world: &mut World| build(world, instance, &file));
    }
}

/// Reports scene files and models that fail to load.
pub(super) fn watch(
    mut commands: Commands,
    mut scenes: MessageReader<AssetLoadFailedEvent<SceneFile>>,
    mut models: MessageReader<AssetLoadFailedEvent<ModalAsset>>,
    instances: Query<(Entity, &SceneInstance)>,
    bodies: Query<(Entity, &PartOf, &SceneBody, &ModalBody, &SceneSource)>,
) {
    for failed in scenes.read() {
        for (instance, _) in instances.iter().filter(|(_, handle)| handle.0.id() == failed.id) {
            // The error of the loader has the line and the column.
            let message = failed.error.to_string();
            let error = match &failed.error {
                bevy::asset::AssetLoadError::AssetLoaderError(inner) => {
                    inner.error().downcast_ref::<SceneError>().cloned()
                }
                _ => None,
            };
            let path = failed.path.to_string();
            let error =
                error.unwrap_or_else(|| SceneError::without_place(&path, SceneErrorKind::Read, message));
            commands.queue(move |world: &mut World| fail(world, instance, error));
        }
    }
    for failed in models.read() {
        let mut reported = Vec::new();
        for (entity, part, body, _, source) in
            bodies.iter().filter(|(.., body, _)| body.model.id() == failed.id)
        {
            commands.entity(entity).try_insert(Lost);
            // One report covers all copies.
            if reported.contains(&(part.0, body.entry)) {
                continue;
            }
            reported.push((part.0, body.entry));
            let message = format!(
                "the body `{}` cannot be loaded: {}",
                source.file.scene().bodies.get(body.entry).map_or("", |entry| entry.name.as_str()),
                failed.error
            );
            let path = [source.path.as_slice(), &[Field("model")]].concat();
            let error = source.file.error(&path, SceneErrorKind::Asset, message);
            let instance = part.0;
            commands.queue(move |world: &mut World| fail(world, instance, error));
        }
    }
}

/// Reports bodies whose settings are refused.
pub(super) fn watch_settings(
    refused: On<BodyRefused>,
    mut commands: Commands,
    bodies: Query<(&PartOf, &Name, &SceneSource), (With<SceneBody>, Without<BodyState>)>,
    lost: Query<(Entity, &PartOf, &SceneSource), With<Lost>>,
) {
    let Ok((part, name, source)) = bodies.get(refused.entity) else { return };
    commands.entity(refused.entity).try_insert(Lost);
    // One report covers all copies.
    let is_copy = |(entity, of, from): (Entity, &PartOf, &SceneSource)| {
        entity != refused.entity && of.0 == part.0 && from.path == source.path
    };
    if lost.iter().any(is_copy) {
        return;
    }
    let message = format!("the body `{name}` cannot be made: {}", refused.error);
    let error = source.file.error(&source.path, SceneErrorKind::Value, message);
    let instance = part.0;
    commands.queue(move |world: &mut World| fail(world, instance, error));
}

/// Reports bodies that fail to bake.
#[cfg(feature = "bake")]
pub(super) fn watch_bakes(
    failed: On<crate::body::BakeFailed>,
    mut commands: Commands,
    bodies: Query<(&PartOf, &Name, &SceneSource), With<SceneBody>>,
) {
    let Ok((part, name, source)) = bodies.get(failed.entity) else { return };
    let message = format!("the body `{name}` cannot be made: {}", failed.error);
    let path = [source.path.as_slice(), &[Field("bake"), Field("shape")]].concat();
    let error = source.file.error(&path, SceneErrorKind::Asset, message);
    let instance = part.0;
    commands.entity(failed.entity).try_insert(Lost);
    commands.queue(move |world: &mut World| fail(world, instance, error));
}

/// Starts the clocks of the scripts once every body of the scene exists or has failed.
pub(super) fn begin(
    time: Res<Time>,
    mut instances: Query<(&mut SceneClock, &SceneParts), With<Made>>,
    bodies: Query<AnyOf<(&BodyState, &Lost)>, With<SceneBody>>,
    all: Query<(), With<SceneBody>>,
) {
    for (mut clock, parts) in &mut instances {
        let there = |part: &Entity| bodies.contains(*part) || !all.contains(*part);
        if clock.began.is_none() && parts.entities().iter().all(there) {
            clock.began = Some(time.elapsed_secs_f64());
        }
    }
}

fn build(world: &mut World, instance: Entity, file: &SceneFile) {
    let Ok(mut entity) = world.get_entity_mut(instance) else { return };
    // The file has changed and the scene is built again.
    entity.despawn_related::<SceneParts>();
    entity.insert((Made, SceneClock::default()));
    let place = entity.get::<GlobalTransform>().copied().unwrap_or_default();
    let role = entity.get::<NetworkRole>().copied().unwrap_or_default();
    let scene = file.scene();
    // An app that was built for the scene has these plugins, or `SceneFilePlugin::open` has failed.
    if role == NetworkRole::Asset {
        for error in not_in_a_game(file) {
            fail(world, instance, error);
        }
    }
    for (entry, body) in scene.bodies.iter().enumerate() {
        if let Err(unmade) = can_be_made(world, file, role, (entry, body)) {
            if let Some(error) = unmade {
                fail(world, instance, error);
            }
            continue;
        }
        for copy in 0..body.count() {
            spawn_body(world, instance, file, place, role, (entry, body), copy);
        }
    }
    let ours = if role == NetworkRole::Guest { By::Guest } else { By::Here };
    for (entry, grab) in scene.grabs.iter().enumerate().filter(|(_, grab)| grab.by == ours) {
        world.spawn((
            Name::new(grab.name.clone()),
            super::hands::ScriptedHand::new(grab.clone()),
            SceneSource { file: file.clone(), path: vec![Field("grabs"), Item(entry)] },
            PartOf(instance),
        ));
    }
    #[cfg(feature = "haptics")]
    if let Some(device) = scene.device.as_ref().filter(|_| role != NetworkRole::Guest)
        && let Err(error) = super::device::add(world, instance, file, device)
    {
        fail(world, instance, error);
    }
    #[cfg(feature = "net")]
    if role == NetworkRole::Opened {
        super::network::spawn_views(world, instance, file, place);
    }
}

/// Returns an error for each request of the scene that only an app built for it can meet.
fn not_in_a_game(file: &SceneFile) -> Vec<SceneError> {
    let scene = file.scene();
    let mut errors = file.lacking(compiled);
    let asked = [
        ("network", "a network", scene.network.is_some() && compiled("net")),
        ("recording", "a recording", scene.recording.is_some() && compiled("rerun")),
    ];
    for (field, what, _) in asked.into_iter().filter(|(.., asked)| *asked) {
        let message = format!(
            "this scene asks for {what}, which an app gets when it is built (`SceneFilePlugin::open`); the scene goes on without it"
        );
        errors.push(file.error(&[Field(field)], SceneErrorKind::Feature, message));
    }
    errors
}

/// Returns whether the host owns a body, so that the body arrives over the session.
fn is_hosts(world: &World, file: &SceneFile, role: NetworkRole, body: &BodyEntry) -> bool {
    let scene = file.scene();
    let shared = body.shared.unwrap_or(scene.network.is_some());
    let joins = shared && matches!(scene.network, Some(NetworkEntry::Join { .. }));
    match role {
        NetworkRole::Guest => true,
        NetworkRole::Opened => joins,
        // The session belongs to the game. The host owns the body only if the game is a guest.
        #[cfg(feature = "net")]
        NetworkRole::Asset => joins && world.contains_resource::<crate::net::NetGuest>(),
        #[cfg(not(feature = "net"))]
        NetworkRole::Asset => {
            let _ = world;
            false
        }
    }
}

/// Refuses a body that can never be made; the error is `None` if the cause was reported elsewhere.
fn can_be_made(
    world: &World,
    file: &SceneFile,
    role: NetworkRole,
    (entry, body): (usize, &BodyEntry),
) -> Result<(), Option<SceneError>> {
    if is_hosts(world, file, role, body) || body.model.is_some() {
        return Ok(());
    }
    // The body would arrive from a host. The missing session was reported already.
    if body.bake.is_none() {
        return Err(None);
    }
    #[cfg(feature = "bake")]
    if !world.contains_resource::<crate::body::Bakery>() {
        let message = format!("the body `{}` is to be baked, and this app has no `BakePlugin`", body.name);
        let path = [Field("bodies"), Item(entry), Field("bake")];
        return Err(Some(file.error(&path, SceneErrorKind::Feature, message)));
    }
    let _ = entry;
    if compiled("bake") { Ok(()) } else { Err(None) }
}

fn spawn_body(
    world: &mut World,
    instance: Entity,
    file: &SceneFile,
    place: GlobalTransform,
    role: NetworkRole,
    (entry, body): (usize, &BodyEntry),
    copy: usize,
) {
    let scene = file.scene();
    let shared = body.shared.unwrap_or(scene.network.is_some());
    let guest = is_hosts(world, file, role, body);
    if role == NetworkRole::Guest && !shared {
        return;
    }
    let transform = place.mul_transform(body.transform(copy)).compute_transform();
    let path = vec![Field("bodies"), Item(entry)];
    let mut spawned = world.spawn((
        Name::new(body.name_of(copy)),
        SceneBody { entry },
        SceneSource { file: file.clone(), path },
        PartOf(instance),
        transform,
    ));
    #[cfg(feature = "net")]
    if shared {
        spawned.insert(crate::net::SharedBody::named(body.name_of(copy)));
    }
    if !body.pointer {
        spawned.insert(NoPointerGrab);
    }
    let id = spawned.id();
    if let Some(model) = body.model.clone() {
        let Some(assets) = world.get_resource::<AssetServer>() else { return };
        let model = assets.load(model);
        // A model that is loaded here need not be sent.
        let mut made = world.entity_mut(id);
        if guest {
            made.insert(KeptEntry(model))
        } else {
            made.insert(ModalBody { model, ..body.modal() })
        };
    }
    #[cfg(feature = "bake")]
    if let Some(bake) = body.bake.as_ref().filter(|_| !guest) {
        use crate::bake::{Anchor, BakeConfig, Region};
        use crate::body::{BakeRequest, BakeShape};
        use crate::modal::Damping;
        let root = world.get_resource::<AssetRoot>().map(|root| root.0.clone()).unwrap_or_default();
        // The check of the scene has read this text, too.
        let of_material = BakeConfig::of_material(&bake.material).unwrap_or_default();
        let config = BakeConfig {
            name: body.name.clone(),
            modes: bake.modes,
            young: bake.young,
            poisson: bake.poisson,
            density: bake.density,
            damping: Damping::Ratio(bake.damping_ratio),
            // The check of the scene has parsed these texts before.
            anchors: bake.anchors.iter().filter_map(|anchor| anchor.parse::<Anchor>().ok()).collect(),
            regions: bake.regions.iter().filter_map(|region| region.parse::<Region>().ok()).collect(),
            ..of_material
        };
        let shape = BakeShape::File(root.join(&bake.shape));
        let request = BakeRequest { tets: bake.tets, config, ..BakeRequest::new(shape) };
        world.entity_mut(id).insert((body.modal(), request));
    }
    #[cfg(feature = "render")]
    if let Some(mut materials) = world.get_resource_mut::<Assets<StandardMaterial>>() {
        let [r, g, b] = body.color.map(|part| part as f32);
        let material = materials.add(StandardMaterial {
            base_color: Color::srgb(r, g, b),
            perceptual_roughness: body.roughness as f32,
            ..default()
        });
        world.entity_mut(id).insert(MeshMaterial3d(material));
    }
}

impl TransformEntry {
    /// Returns the transform for Bevy, with rotations about x, then y, then z.
    pub fn transform(&self) -> Transform {
        let [x, y, z] = self.turn.map(|degrees| degrees.to_radians() as f32);
        Transform {
            translation: DVec3::from(self.at).as_vec3(),
            rotation: Quat::from_euler(EulerRot::ZYX, z, y, x),
            scale: Vec3::splat(self.scale as f32),
        }
    }
}

impl BodyEntry {
    /// Returns the transform of one copy in the scene.
    pub fn transform(&self, copy: usize) -> Transform {
        let mut place = self.place.transform();
        if let Some(copies) = self.copies {
            let columns = copies.count[0].max(1);
            let middle = |count: usize| (count.saturating_sub(1)) as f64 / 2.0;
            let x = (copy % columns) as f64 - middle(copies.count[0]);
            let z = (copy / columns) as f64 - middle(copies.count[1]);
            place.translation +=
                Vec3::new((x * copies.spacing[0]) as f32, 0.0, (z * copies.spacing[1]) as f32);
        }
        place
    }

    /// Returns the settings of the body, without a model.
    pub(super) fn modal(&self) -> ModalBody {
        let defaults = ModalBody::default();
        ModalBody {
            settings: self.settings,
            modes: self.modes,
            half_basis: self.half_basis,
            rest_speed: self.rest_speed.unwrap_or(defaults.rest_speed),
            ..defaults
        }
    }
}

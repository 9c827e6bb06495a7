//! Baking inside the running game.

mod extras;
mod from_mesh;
mod job;
mod node;
mod process;
mod request;
mod settings;

use std::collections::VecDeque;

use bevy::prelude::*;
use pliant_bake::BakeCache;

pub use extras::BakeExtrasError;
pub use from_mesh::{ATTRIBUTE_ANCHOR, ATTRIBUTE_DENSITY, ATTRIBUTE_STIFFNESS};
pub use node::BakeNode;
pub use process::BakeProcessor;
pub use request::{BakeBodyError, BakeFailed, BakeProgress, BakeRequest, BakeShape, BakeSkin, BakeStage};
pub use settings::BakeSettings;

use crate::{ModalAsset, ModalBody};
use from_mesh::resolve;
use job::{BakeJob, Outcome};

/// Bakes the bodies of [`BakeRequest`]s on separate threads while the game runs.
///
/// A bake consists of meshing, finite elements and modes. One bake runs at a time, on half of the
/// cores. The other requests wait in the order of their arrival. The entity's [`BakeProgress`]
/// shows the progress, and the entity's [`ModalBody`] gets the model when the bake is done.
/// Changing the request starts a new bake. Removing the request or despawning the entity cancels
/// the bake: a waiting request is dropped, and a running bake ends after its current part without a
/// message.
///
/// Finished bakes are kept on disk under the hash of the request, so that an unchanged request is
/// only read.
#[derive(Debug, Clone)]
pub struct BakePlugin {
    /// Cache of finished bakes. Default: the user's cache, which `pliant bake` also uses. `None`
    /// keeps nothing.
    pub cache: Option<BakeCache>,
}

impl Default for BakePlugin {
    fn default() -> Self {
        Self { cache: BakeCache::of_user() }
    }
}

impl Plugin for BakePlugin {
    fn build(&self, app: &mut App) {
        app.register_asset_processor(BakeProcessor)
            .register_type::<BakeRequest>()
            .register_type::<BakeNode>()
            .register_type::<BakeSettings>()
            .register_type::<BakeFailed>()
            .register_type::<BakeProgress>()
            .register_type::<BakeStage>()
            .insert_resource(Bakery { cache: self.cache.clone(), waiting: VecDeque::new(), running: None })
            .add_observer(forget)
            .add_systems(PreUpdate, (node::bake_nodes, take_orders, work).chain());
    }
}

/// The running bake and the waiting requests. An app has it where it has the [`BakePlugin`].
#[derive(Resource)]
pub struct Bakery {
    cache: Option<BakeCache>,
    waiting: VecDeque<Entity>,
    running: Option<BakeJob>,
}

fn forget(removed: On<Remove, BakeRequest>, mut bakery: ResMut<Bakery>, mut commands: Commands) {
    bakery.drop_order(removed.entity);
    if let Ok(mut entity) = commands.get_entity(removed.entity) {
        entity.try_remove::<BakeProgress>();
    }
}

impl Bakery {
    fn drop_order(&mut self, entity: Entity) {
        self.waiting.retain(|&waiting| waiting != entity);
        if let Some(job) = &mut self.running
            && job.entity == Some(entity)
        {
            // A thread cannot be stopped from outside. The bake ends by itself and its result is
            // dropped.
            job.cancel();
        }
    }
}

fn take_orders(
    mut bakery: ResMut<Bakery>,
    mut requests: Query<(Entity, &mut BakeProgress), Changed<BakeRequest>>,
) {
    // A query has no order of its own, and requests of one frame are made in the order of spawning.
    let mut new: Vec<_> = requests.iter_mut().collect();
    new.sort_by_key(|(entity, _)| entity.index_u32());
    for (entity, mut progress) in new {
        bakery.drop_order(entity);
        bakery.waiting.push_back(entity);
        *progress = BakeProgress::Waiting;
    }
}

fn work(
    mut commands: Commands,
    mut bakery: ResMut<Bakery>,
    mut models: ResMut<Assets<ModalAsset>>,
    (meshes, server): (Option<Res<Assets<Mesh>>>, Option<Res<AssetServer>>),
    mut requests: Query<(NameOrEntity, &BakeRequest, &mut BakeProgress, Option<&mut ModalBody>)>,
) {
    // In nearly every frame of a game no bake waits and none runs.
    if bakery.running.is_none() && bakery.waiting.is_empty() {
        return;
    }
    if let Some(job) = &mut bakery.running {
        let order = job.entity.and_then(|entity| requests.get_mut(entity).ok());
        match (job.poll(), order) {
            (None, Some((_, _, mut progress, _))) => {
                let now = job.progress();
                if *progress != now {
                    *progress = now;
                }
            }
            (None, None) => {}
            (Some(outcome), order) => {
                bakery.running = None;
                if let Some((name, _, mut progress, body)) = order {
                    match outcome {
                        Outcome::Baked { model, seconds, cached, repair } => {
                            if let Some(repair) = repair {
                                warn!("{name}: the surface was mended: {repair}");
                            }
                            let model = models.add(ModalAsset::from(*model));
                            *progress = BakeProgress::Done { seconds, cached, repair };
                            match body {
                                Some(mut body) => body.model = model,
                                None => {
                                    commands.entity(name.entity).try_insert(ModalBody::new(model));
                                }
                            }
                        }
                        Outcome::Failed(error) => {
                            error!("{name}: {error}");
                            *progress = BakeProgress::Failed { reason: error.to_string() };
                            commands.trigger(BakeFailed { entity: name.entity, error });
                        }
                        Outcome::Cancelled => {}
                    }
                }
            }
        }
    }
    // Requests whose meshes are still being loaded let the others pass.
    let mut loading = VecDeque::new();
    while bakery.running.is_none()
        && let Some(entity) = bakery.waiting.pop_front()
    {
        let Ok((name, request, mut progress, _)) = requests.get_mut(entity) else { continue };
        match resolve(request, meshes.as_deref(), server.as_deref()) {
            Ok(Some(request)) => {
                let job = BakeJob::start(entity, request, bakery.cache.clone());
                *progress = job.progress();
                bakery.running = Some(job);
            }
            Ok(None) => loading.push_back(entity),
            Err(error) => {
                error!("{name}: {error}");
                *progress = BakeProgress::Failed { reason: error.to_string() };
                commands.trigger(BakeFailed { entity, error });
            }
        }
    }
    loading.append(&mut bakery.waiting);
    bakery.waiting = loading;
}

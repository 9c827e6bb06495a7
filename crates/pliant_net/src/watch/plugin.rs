//! Watching in Bevy.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use bevy::math::DVec3;
use bevy::platform::time::Instant;
use bevy::prelude::*;
use pliant_body::{BodyState, Driven, ModalAsset, ModalBody, PliantDisplaySystems, VisualState};
use pliant_modal::ModalModel;
use pliant_stream::watch::{
    BodyPlayout, Catalog, CatalogBody, HandsPlayout, TickClock, WatchHand, WatchNumbers,
};
use pliant_stream::{BodyId, StepSettings};

use super::WatchView;
use super::follow::{WatchEvent, Watcher};
use super::relay::RelayOptions;
use crate::remote::{RemoteBody, RemoteHand, RemoteHands};
use crate::session_transform::{set_pose, transform_of};
use crate::shared_body::SharedBody;

/// Events of one frame; the rest waits for the next.
const EVENTS: usize = 4096;
/// Time behind the earliest arrivals, beside a frame's interval: what a network is late.
const MARGIN: Duration = Duration::from_millis(40);

/// Watches sessions at relays. Add it after [`PliantBodyPlugin`](pliant_body::PliantBodyPlugin).
///
/// The bodies of the session appear as entities with [`RemoteBody`], [`SharedBody`],
/// [`ModalBody`], [`RemoteHands`], [`WatchView`] and the host's transform, and move between the
/// host's frames a little behind them. They end when the session ends. A host that comes again is
/// found again. What the app draws them with is its own choice, as for a guest's bodies.
#[derive(Debug, Default)]
pub struct WatchPlugin;

/// Where the app stands with the session that it watches.
#[derive(Resource, Reflect, Debug, Default, Clone, PartialEq)]
#[reflect(Resource, Debug, Default, Clone, PartialEq)]
pub struct WatchState {
    /// Whether a relay is connected.
    pub connected: bool,
    /// The catalog of the session. `None` while the host is not there.
    #[reflect(ignore)]
    pub catalog: Option<Catalog>,
    /// People, loss, round trip, and what the host has dropped.
    #[reflect(ignore)]
    pub numbers: WatchNumbers,
    /// Number of frames that have arrived.
    pub frames: u64,
    /// What arrived and was wrong: how often, and the last reason.
    pub wrong: (u64, String),
    /// Why the relay was lost or not reached the last time. Empty if that was never so.
    pub relay_error: String,
}

/// The session that this app watches.
#[derive(Resource)]
pub(crate) struct Watched {
    watcher: Watcher,
    began: Instant,
    clock: Option<TickClock>,
    bodies: BTreeMap<BodyId, WatchedBody>,
    hands: HandsPlayout,
    scratch: Vec<f64>,
}

struct WatchedBody {
    entity: Entity,
    body: CatalogBody,
    playout: BodyPlayout,
}

/// Watches a session while the app runs. The app needs a [`WatchPlugin`].
pub trait WatchCommands {
    /// Watches a session at a relay, in place of the one that was watched before. An address that
    /// is none is logged and seen in [`WatchState::wrong`].
    fn watch_session(&mut self, options: RelayOptions);

    /// Stops watching. The bodies of the session are despawned.
    fn stop_watching(&mut self);
}

impl WatchCommands for Commands<'_, '_> {
    fn watch_session(&mut self, options: RelayOptions) {
        self.queue(move |world: &mut World| {
            stop(world);
            match Watcher::open(&options, Vec::new()) {
                Ok(watcher) => world.insert_resource(Watched {
                    watcher,
                    began: Instant::now(),
                    clock: None,
                    bodies: BTreeMap::new(),
                    hands: HandsPlayout::default(),
                    scratch: Vec::new(),
                }),
                Err(error) => {
                    error!("nothing is watched: {error}");
                    world.insert_resource(WatchState {
                        wrong: (1, error.to_string()),
                        ..WatchState::default()
                    });
                }
            }
        });
    }

    fn stop_watching(&mut self) {
        self.queue(stop);
    }
}

fn stop(world: &mut World) {
    if let Some(mut watched) = world.remove_resource::<Watched>() {
        watched.clear(world);
    }
    world.insert_resource(WatchState::default());
}

impl Plugin for WatchPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<WatchState>()
            .register_type::<WatchState>()
            .register_type::<WatchView>()
            .register_type::<RemoteBody>()
            .register_type::<RemoteHands>()
            .register_type::<SharedBody>()
            .add_systems(PreUpdate, follow.run_if(resource_exists::<Watched>))
            .add_systems(
                PostUpdate,
                show.before(PliantDisplaySystems::Interpolate).run_if(resource_exists::<Watched>),
            );
    }
}

/// `PreUpdate`: takes what has arrived.
fn follow(world: &mut World) {
    let Some(mut watched) = world.remove_resource::<Watched>() else { return };
    let Some(mut state) = world.remove_resource::<WatchState>() else { return };
    let now = watched.began.elapsed();
    for _ in 0..EVENTS {
        let Some(event) = watched.watcher.poll() else { break };
        watched.take(world, &mut state, now, event);
    }
    world.insert_resource(state);
    world.insert_resource(watched);
}

impl Watched {
    fn take(&mut self, world: &mut World, state: &mut WatchState, now: Duration, event: WatchEvent) {
        match event {
            WatchEvent::Relay(connected) => state.connected = connected,
            WatchEvent::RelayError(why) => state.relay_error = why,
            WatchEvent::Catalog(catalog) => {
                let same = |old: &Catalog| old.session == catalog.session && old.step == catalog.step;
                if !state.catalog.as_ref().is_some_and(same) {
                    self.clear(world);
                    self.clock = Some(TickClock::new(catalog.step));
                }
                for body in &catalog.bodies {
                    self.looks(world, body);
                }
                state.catalog = Some(catalog);
            }
            WatchEvent::Body(body, model) => {
                // It may have been painted or moved while its model was fetched.
                let bodies = state.catalog.as_ref().map_or(&[][..], |catalog| &catalog.bodies);
                let now = bodies.iter().find(|now| body.goes_on_as(now)).cloned();
                self.arrived(world, now.unwrap_or(body), model);
            }
            WatchEvent::State(id, new) => {
                state.frames += 1;
                // Who comes late gets the last frame of a sleeping body, however old it is.
                if let Some(clock) = self.clock.as_mut().filter(|_| !new.resting) {
                    clock.arrived(new.tick, now);
                }
                if let Some(body) = self.bodies.get_mut(&id) {
                    body.playout.push(new);
                }
            }
            WatchEvent::Gone(id) => {
                if let Some(body) = self.bodies.remove(&id) {
                    world.try_despawn(body.entity).ok();
                }
            }
            WatchEvent::Hands(hands) => {
                // They come while all bodies sleep, too, and say which tick it is.
                if let Some(clock) = &mut self.clock {
                    clock.arrived(hands.tick, now);
                }
                state.numbers = hands.numbers;
                self.hands.push(hands);
            }
            WatchEvent::Over => {
                self.clear(world);
                state.catalog = None;
            }
            WatchEvent::Wrong(reason) => {
                debug!("the watched session sends what is wrong: {reason}");
                state.wrong = (state.wrong.0 + 1, reason);
            }
        }
    }

    fn arrived(&mut self, world: &mut World, body: CatalogBody, model: Arc<ModalModel>) {
        if let Some(known) = self.bodies.remove(&body.id) {
            world.try_despawn(known.entity).ok();
        }
        let Some(mut assets) = world.get_resource_mut::<Assets<ModalAsset>>() else {
            error_once!("a watched body has arrived, but the app has no PliantBodyPlugin");
            return;
        };
        let known = assets.iter().find(|(_, asset)| asset.0.hash() == model.hash()).map(|(id, _)| id);
        let known = known.and_then(|id| assets.get_strong_handle(id));
        let handle = known.unwrap_or_else(|| assets.add(ModalAsset::from(model)));
        let new = ModalBody::new(handle);
        let settings = StepSettings { warp: body.warps, ..new.settings };
        let entity = world
            .spawn((
                SharedBody::named(body.name.clone()),
                transform_of(body.placement),
                ModalBody { settings, ..new },
                Driven::Remote,
                RemoteBody(body.id),
                RemoteHands::default(),
                view_of(&body),
            ))
            .id();
        let playout = BodyPlayout::new(body.every.into());
        self.bodies.insert(body.id, WatchedBody { entity, body, playout });
    }

    /// Takes the name, the color and the placement of a body that is there already.
    fn looks(&mut self, world: &mut World, new: &CatalogBody) {
        let Some(body) = self.bodies.get_mut(&new.id).filter(|body| body.body.goes_on_as(new)) else {
            return;
        };
        let old = std::mem::replace(&mut body.body, new.clone());
        let Ok(mut entity) = world.get_entity_mut(body.entity) else { return };
        if old.name != new.name {
            entity.insert(SharedBody::named(new.name.clone()));
        }
        if old.color != new.color {
            entity.insert(view_of(new));
        }
        if old.placement != new.placement
            && let Some(mut transform) = entity.get_mut::<Transform>()
        {
            let placed = transform_of(new.placement);
            let moves = body.playout.newest().is_some_and(|state| state.pose.is_some());
            // Frames with poses say where the body is.
            *transform = if moves { Transform { scale: placed.scale, ..*transform } } else { placed };
        }
    }

    fn clear(&mut self, world: &mut World) {
        self.hands = HandsPlayout::default();
        for (_, body) in std::mem::take(&mut self.bodies) {
            world.try_despawn(body.entity).ok();
        }
    }
}

fn view_of(body: &CatalogBody) -> WatchView {
    let [r, g, b, a] = body.color.map(|part| f32::from(part) / 255.0);
    WatchView { color: Srgba::new(r, g, b, a), hidden: false }
}

/// `PostUpdate`: writes what is displayed at this time.
fn show(
    watched: ResMut<Watched>,
    state: Res<WatchState>,
    mut bodies: Query<(&BodyState, &mut VisualState, &mut Transform, &mut RemoteHands)>,
) {
    let watched = watched.into_inner();
    let (Some(clock), Some(catalog)) = (&watched.clock, &state.catalog) else { return };
    let now = watched.began.elapsed();
    let delayed =
        |every: u16| clock.tick(now, Duration::from_secs_f64(f64::from(every) * catalog.step) + MARGIN);
    let mut hands: BTreeMap<BodyId, Vec<RemoteHand>> = BTreeMap::new();
    // Hands come as often as bodies, and are where they were at the body's time.
    let shown = catalog.bodies.first().and_then(|body| delayed(body.every));
    for hand in shown.map(|tick| watched.hands.at(tick)).unwrap_or_default() {
        hands.entry(hand.body).or_default().push(remote_hand(&hand));
    }
    for (id, body) in &mut watched.bodies {
        let Ok((state, mut visual, mut transform, mut shown)) = bodies.get_mut(body.entity) else { continue };
        shown.set_if_neq(RemoteHands(hands.remove(id).unwrap_or_default()));
        let Some(tick) = delayed(body.body.every) else { continue };
        let Some(pose) = body.playout.at(tick, &mut watched.scratch) else { continue };
        watched.scratch.resize(visual.q().len(), 0.0);
        if watched.scratch != visual.q()
            && let Err(error) = visual.snap(&watched.scratch)
        {
            debug!("a watched state was not displayed: {error}");
        }
        if let Some(pose) = pose {
            set_pose(&mut transform, &pose, &pose, 1.0, state.scale());
        }
    }
}

fn remote_hand(hand: &WatchHand) -> RemoteHand {
    RemoteHand {
        user: hand.key.user,
        // Watchers do not receive where on the surface a hand is.
        vertex: 0,
        target: DVec3::from(hand.target),
        reaction: DVec3::from(hand.reaction),
    }
}

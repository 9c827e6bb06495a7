//! The host's side: what it publishes.

mod carry;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use bevy::prelude::*;
use pliant_modal::{ModalModel, ModelHash};
use pliant_stream::watch::{
    BodyEncoder, Catalog, CatalogBody, CatalogCamera, MAX_MODEL, WatchConfig, WatchHand, WatchHands,
    WatchNumbers, WatchSurface,
};
use pliant_stream::{BodyId, MAGNITUDE_LIMIT, Placement, RigidState, Tick, TickState};
use tokio::sync::mpsc::{Sender, channel};

use self::carry::carry;
use super::relay::{RelayOptions, WatchError, without_token};

/// Frames that wait for the thread of the relay. More are dropped and counted.
const QUEUE: usize = 1024;
/// Least time between two catalogs that differ only in how bodies look and where they are, s.
const LOOKS_EVERY: f64 = 0.1;
/// How long the end of the session may take.
const GOODBYE: Duration = Duration::from_millis(500);

/// What watchers get of a host's session.
#[derive(Debug, Clone)]
pub struct PublishOptions {
    /// The relay and the name of the session there.
    pub relay: RelayOptions,
    /// Address of the relay in links for watchers, where it is another one than the host's: with a
    /// token for watchers, or a relay nearer to them. Default: the host's without its token.
    pub link_relay: Option<String>,
    /// Name of the session for display, at most 64 bytes. Default: none.
    pub title: String,
    /// Rate, coordinates and resolution of all bodies. Default: 30 Hz, 30 coordinates, 1e-4 of a
    /// body's size.
    pub bodies: WatchConfig,
    /// Whether watchers see where hands are and what forces they feel. Default: true.
    pub hands: bool,
    /// Whether watchers get the number of people, loss and round trip. Default: true.
    pub numbers: bool,
    /// Whether apps can fetch the whole `.modal` files, which they need to draw the bodies. Pages
    /// in browsers do not. Default: true.
    pub files: bool,
    /// Places from which to look, at most 64. Default: none, and watchers look so that they see
    /// everything.
    pub cameras: Vec<CatalogCamera>,
}

impl PublishOptions {
    /// Publishes all bodies and hands at a relay, with the defaults.
    pub fn new(relay: RelayOptions) -> Self {
        Self {
            relay,
            link_relay: None,
            title: String::new(),
            bodies: WatchConfig::default(),
            hands: true,
            numbers: true,
            files: true,
            cameras: Vec::new(),
        }
    }

    /// Link to a page that shows the session. `page` is the address of the page that `pliant
    /// watch-page` writes, or of another one that reads `relay`, `session` and any number of
    /// `certificate` (SHA-256 hashes) from the fragment of its own address.
    pub fn link(&self, page: &str) -> String {
        let relay = self.link_relay.clone().unwrap_or_else(|| without_token(&self.relay.relay));
        self.relay.link(page, &relay)
    }
}

/// How watchers see a [`SharedBody`](crate::SharedBody) of the host. Bodies without this component
/// are shown in light gray.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Clone, PartialEq, Default)]
pub struct WatchView {
    /// Color and opacity. Default: light gray.
    pub color: Srgba,
    /// Watchers do not get the body. Default: false.
    pub hidden: bool,
}

impl Default for WatchView {
    fn default() -> Self {
        Self { color: Srgba::rgb(0.8, 0.8, 0.82), hidden: false }
    }
}

/// What has been published so far.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PublishStats {
    /// Whether the relay is connected.
    pub connected: bool,
    /// How often it was connected.
    pub connections: u64,
    /// Why the relay was not reached or was lost the last time. Empty if that was never so. A relay
    /// that refuses a token is connected and lost at once, again and again.
    pub relay_error: String,
    /// Frames handed to the thread of the relay.
    pub frames: u64,
    /// Bytes in these frames.
    pub bytes: u64,
    /// Frames dropped, because that thread was behind. The body begins a new group after it.
    pub dropped: u64,
}

#[derive(Debug, Default)]
struct Shared {
    connected: AtomicBool,
    connections: AtomicU64,
    relay_error: Mutex<String>,
}

/// For the thread of the relay.
enum Item {
    Catalog(Tick, Vec<u8>),
    /// A model, the number of its modes that watchers get, and whether they get its file.
    Model(Arc<ModalModel>, usize, bool),
    Frame(BodyId, Tick, bool, Vec<u8>),
    Hands(Tick, Vec<u8>),
    /// A body is gone, and with it its model, if no other body has it.
    Gone(BodyId, Option<ModelHash>),
}

/// A removed body that the thread has no message about yet.
struct Gone {
    id: BodyId,
    model: ModelHash,
}

struct PublishedBody {
    encoder: BodyEncoder,
    entry: CatalogBody,
    model: Arc<ModalModel>,
    /// The thread was behind when the body was announced, so it is announced again.
    announced: bool,
    seen: bool,
    /// An anchored body has been moved since it was announced. From then on its frames have poses.
    moves: bool,
    /// Where it was in its last frame.
    shown_at: Placement,
}

/// A body at a tick, as the host has it.
pub(crate) struct Seen<'a> {
    pub(crate) id: BodyId,
    pub(crate) name: &'a str,
    pub(crate) model: &'a Arc<ModalModel>,
    pub(crate) warps: bool,
    pub(crate) placement: Placement,
    pub(crate) view: Option<&'a WatchView>,
    pub(crate) state: &'a TickState<'a>,
}

/// What a host publishes. Each call costs the tick that it is made in; nothing waits.
pub(crate) struct HostWatch {
    options: PublishOptions,
    step: f64,
    session: u64,
    queue: Sender<Item>,
    shared: Arc<Shared>,
    bodies: BTreeMap<BodyId, PublishedBody>,
    hands: Vec<WatchHand>,
    gone: Vec<Gone>,
    catalog: CatalogNews,
    /// When the last catalog was sent.
    catalog_at: Tick,
    stats: PublishStats,
}

/// What the last catalog lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum CatalogNews {
    Nothing,
    /// Names, colors or placements. A catalog has all bodies in it, so these wait a moment.
    Looks,
    /// Bodies.
    Bodies,
}

impl HostWatch {
    pub(crate) fn start(options: PublishOptions, step: f64) -> Result<Self, WatchError> {
        options.bodies.check()?;
        let relay = options.relay.open()?;
        let name = options.relay.session.clone();
        let shared = Arc::new(Shared::default());
        let (queue, items) = channel(QUEUE);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|error| WatchError::Setup(error.to_string()))?;
        let of_thread = shared.clone();
        thread::Builder::new()
            .name("pliant-watch".into())
            .spawn(move || {
                let tasks = tokio::task::LocalSet::new();
                let end = runtime.block_on(tasks.run_until(carry(relay, name, items, of_thread, step)));
                if let Err(error) = end {
                    tracing::error!("nothing more is published for watchers: {error}");
                }
                runtime.shutdown_timeout(GOODBYE);
            })
            .map_err(|error| WatchError::Setup(error.to_string()))?;
        Self::with_queue(options, step, queue, shared)
    }

    fn with_queue(
        options: PublishOptions,
        step: f64,
        queue: Sender<Item>,
        shared: Arc<Shared>,
    ) -> Result<Self, WatchError> {
        let mut random = [0; 8];
        let filled = ring::rand::SecureRandom::fill(&ring::rand::SystemRandom::new(), &mut random);
        filled.map_err(|_| WatchError::Setup("no random numbers".into()))?;
        Ok(Self {
            options,
            step,
            session: u64::from_le_bytes(random),
            queue,
            shared,
            bodies: BTreeMap::new(),
            hands: Vec::new(),
            gone: Vec::new(),
            catalog: CatalogNews::Bodies,
            catalog_at: 0,
            stats: PublishStats::default(),
        })
    }

    pub(crate) fn options(&self) -> &PublishOptions {
        &self.options
    }

    pub(crate) fn stats(&self) -> PublishStats {
        PublishStats {
            connected: self.shared.connected.load(Ordering::Relaxed),
            connections: self.shared.connections.load(Ordering::Relaxed),
            relay_error: self.shared.relay_error.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            ..self.stats.clone()
        }
    }

    fn send(&mut self, item: Item, bytes: usize) -> bool {
        let sent = self.queue.try_send(item).is_ok();
        if sent {
            self.stats.frames += 1;
            self.stats.bytes += bytes as u64;
        } else {
            self.stats.dropped += 1;
        }
        sent
    }

    /// A body at this tick.
    pub(crate) fn body(&mut self, seen: &Seen<'_>) {
        let view = seen.view.copied().unwrap_or_default();
        if view.hidden {
            return;
        }
        let files = self.options.files && seen.model.file_bytes() <= MAX_MODEL;
        let surface_bytes = WatchSurface::encoded_length(seen.model, self.options.bodies.modes);
        if surface_bytes > MAX_MODEL as u64 {
            warn_once!("the model of {} is too large for watchers", seen.name);
            return;
        }
        // Another model makes it another body, which comes after the end of the first.
        let known = self.bodies.get(&seen.id).map(|body| Arc::ptr_eq(&body.model, seen.model));
        if known == Some(false) || self.gone.iter().any(|gone| gone.id == seen.id) {
            return;
        }
        // Frames of a free body have its pose, and where it began says nothing.
        let free = seen.model.is_free();
        let scaled = Placement { scale: seen.placement.scale, ..Placement::default() };
        let placement = if free { scaled } else { seen.placement };
        if known.is_none() {
            // Watchers refuse a catalog with a place out of range, and with it all bodies.
            if !placement.is_valid() {
                warn_once!("{} is too far away or too large for watchers", seen.name);
                return;
            }
            let Ok(encoder) = BodyEncoder::new(seen.model, self.options.bodies, self.step) else { return };
            let entry = CatalogBody {
                id: seen.id,
                name: seen.name.to_owned(),
                model: seen.model.hash(),
                file_bytes: if files { seen.model.file_bytes() as u64 } else { 0 },
                surface_bytes,
                modes: encoder.modes() as u16,
                every: encoder.every() as u16,
                warps: seen.warps,
                free,
                placement,
                color: [0; 4],
            };
            let model = seen.model.clone();
            let (announced, moves, shown_at) = (false, false, seen.placement);
            let new = PublishedBody { encoder, entry, model, announced, seen: true, moves, shown_at };
            self.bodies.insert(seen.id, new);
        }
        let Some(body) = self.bodies.get_mut(&seen.id) else { return };
        body.seen = true;
        let [r, g, b, a] = view.color.to_f32_array().map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8);
        let place = |at: &Placement| (at.position, at.orientation);
        body.moves |= !free && place(&body.entry.placement) != place(&seen.placement);
        // Once an anchored body is moved, its frames have its pose, too: a catalog is no way to
        // send a movement.
        let placement = Placement { scale: seen.placement.scale, ..body.entry.placement };
        let placement = if placement.is_valid() { placement } else { body.entry.placement };
        let (entry, color) = (&mut body.entry, [r, g, b, a]);
        if entry.warps != seen.warps {
            self.catalog = CatalogNews::Bodies;
        }
        if entry.name != seen.name || (entry.placement, entry.color) != (placement, color) {
            self.catalog = self.catalog.max(CatalogNews::Looks);
            entry.name.clear();
            entry.name.push_str(seen.name);
        }
        (entry.warps, entry.placement, entry.color) = (seen.warps, placement, color);
        let state = match body.moves {
            true => TickState {
                pose: Some(pose_of(&seen.placement)),
                // A sleeping body is awake for watchers until they have where it was moved to.
                resting: seen.state.resting && body.shown_at == seen.placement,
                ..*seen.state
            },
            false => *seen.state,
        };
        if !body.announced {
            let item = Item::Model(body.model.clone(), self.options.bodies.modes, files);
            body.announced = self.queue.try_send(item).is_ok();
            self.catalog = CatalogNews::Bodies;
            if !body.announced {
                return;
            }
        }
        match body.encoder.encode(&state) {
            Ok(Some(frame)) => {
                body.shown_at = seen.placement;
                let bytes = frame.bytes.len();
                let item = Item::Frame(seen.id, seen.state.tick, frame.begins_group, frame.bytes);
                if !self.send(item, bytes)
                    && let Some(body) = self.bodies.get_mut(&seen.id)
                {
                    // What follows would lean on the frame that was dropped.
                    body.encoder.restart();
                }
            }
            Ok(None) => {}
            Err(error) => debug!("watchers do not get a tick of {}: {error}", seen.name),
        }
    }

    /// A hand at this tick, in world axes.
    pub(crate) fn hand(&mut self, hand: WatchHand) {
        // Watchers refuse all hands of a tick for one number that is none.
        let sound = |x: &f64| x.abs() <= MAGNITUDE_LIMIT;
        if self.options.hands && hand.target.iter().chain(&hand.reaction).all(sound) {
            self.hands.push(hand);
        }
    }

    /// After all bodies and hands of a tick.
    pub(crate) fn finish(&mut self, tick: Tick, numbers: WatchNumbers) {
        let gone: Vec<BodyId> = self.bodies.iter().filter(|(_, b)| !b.seen).map(|(id, _)| *id).collect();
        for id in gone {
            let Some(body) = self.bodies.remove(&id) else { continue };
            self.gone.push(Gone { id, model: body.entry.model });
            self.catalog = CatalogNews::Bodies;
        }
        // What the thread has no room for waits for the next tick. Meanwhile another body may have
        // come that has the same model.
        self.gone.retain(|gone| {
            let alone = self.bodies.values().all(|other| other.entry.model != gone.model);
            self.queue.try_send(Item::Gone(gone.id, alone.then_some(gone.model))).is_err()
        });
        self.bodies.values_mut().for_each(|body| body.seen = false);
        let pause = (LOOKS_EVERY / self.step) as Tick;
        let due = match self.catalog {
            CatalogNews::Nothing => false,
            CatalogNews::Looks => tick.abs_diff(self.catalog_at) >= pause,
            CatalogNews::Bodies => true,
        };
        if due {
            let catalog = Catalog {
                session: self.session,
                step: self.step,
                name: self.options.title.clone(),
                bodies: self.bodies.values().map(|body| body.entry.clone()).collect(),
                cameras: self.options.cameras.clone(),
            };
            let bytes = catalog.encode();
            let length = bytes.len();
            if self.send(Item::Catalog(tick, bytes), length) {
                (self.catalog, self.catalog_at) = (CatalogNews::Nothing, tick);
            }
        }
        let hands = std::mem::take(&mut self.hands);
        if tick.is_multiple_of(self.options.bodies.every(self.step)) {
            let numbers = match self.options.numbers {
                true => WatchNumbers { dropped: self.stats.dropped.min(u32::MAX.into()) as u32, ..numbers },
                false => WatchNumbers::default(),
            };
            let bytes = WatchHands { tick, numbers, hands }.encode();
            let length = bytes.len();
            self.send(Item::Hands(tick, bytes), length);
        }
    }
}

/// The pose of an anchored body at a placement, in meters of the body.
fn pose_of(placement: &Placement) -> RigidState {
    let scale = f64::from(placement.scale);
    RigidState {
        position: placement.position.map(|x| f64::from(x) / scale),
        rotation: placement.orientation.map(f64::from),
        ..RigidState::default()
    }
}

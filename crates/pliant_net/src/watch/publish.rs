//! The host's side: what it publishes, and the thread that carries it to the relay.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use bevy::prelude::*;
use moq_net::{Timestamp, broadcast, group, origin, track};
use pliant_modal::{ModalModel, ModelHash};
use pliant_stream::watch::{
    BodyEncoder, CATALOG_TRACK, Catalog, CatalogBody, CatalogCamera, HANDS_TRACK, MAX_MODEL, WatchConfig,
    WatchHand, WatchHands, WatchNumbers, WatchSurface, body_track, model_track, pieces, surface_track,
};
use pliant_stream::{BodyId, Placement, Tick, TickState};
use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::relay::{Relay, RelayOptions, WatchError, without_token};

/// Frames that wait for the thread of the relay. More are dropped and counted.
const QUEUE: usize = 1024;
/// How long a relay keeps a group beside the newest.
const KEEP: Duration = Duration::from_secs(3);
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PublishStats {
    /// Whether the relay is connected.
    pub connected: bool,
    /// How often it was connected.
    pub connections: u64,
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
}

/// For the thread of the relay.
enum Item {
    Catalog(Tick, Vec<u8>),
    Model(Arc<ModalModel>, usize),
    Frame(BodyId, Tick, bool, Vec<u8>),
    Hands(Tick, Vec<u8>),
    /// A body is gone, and with it its model, if no other body has it.
    Gone(BodyId, Option<ModelHash>),
}

struct PublishedBody {
    encoder: BodyEncoder,
    entry: CatalogBody,
    model: Arc<ModalModel>,
    /// The thread was behind when the body was announced, so it is announced again.
    announced: bool,
    seen: bool,
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
    /// Removed bodies that the thread has no message about yet.
    gone: Vec<(BodyId, Option<ModelHash>)>,
    catalog_sent: bool,
    stats: PublishStats,
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
        let scale = step;
        thread::Builder::new()
            .name("pliant-watch".into())
            .spawn(move || {
                let tasks = tokio::task::LocalSet::new();
                let end = runtime.block_on(tasks.run_until(carry(relay, name, items, of_thread, scale)));
                if let Err(error) = end {
                    tracing::error!("nothing more is published for watchers: {error}");
                }
                runtime.shutdown_timeout(GOODBYE);
            })
            .map_err(|error| WatchError::Setup(error.to_string()))?;
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
            catalog_sent: false,
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
            ..self.stats
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
        let same = |body: &PublishedBody| Arc::ptr_eq(&body.model, seen.model);
        let known = self.bodies.get(&seen.id).is_some_and(same);
        if !known {
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
                free: seen.model.is_free(),
                placement: seen.placement,
                color: [0; 4],
            };
            let model = seen.model.clone();
            let (announced, seen_now) = (false, true);
            self.bodies.insert(seen.id, PublishedBody { encoder, entry, model, announced, seen: seen_now });
        }
        let Some(body) = self.bodies.get_mut(&seen.id) else { return };
        body.seen = true;
        let [r, g, b, a] = view.color.to_f32_array().map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8);
        // Frames of a free body have its pose, and where it began says nothing.
        let placement = match body.entry.free {
            true => Placement { scale: seen.placement.scale, ..Placement::default() },
            false => seen.placement,
        };
        let entry = CatalogBody { warps: seen.warps, placement, color: [r, g, b, a], ..body.entry.clone() };
        if entry != body.entry {
            body.entry = entry;
            self.catalog_sent = false;
        }
        if !body.announced {
            let model = body.model.clone();
            body.announced = self.queue.try_send(Item::Model(model, self.options.bodies.modes)).is_ok();
            self.catalog_sent = false;
            if !body.announced {
                return;
            }
        }
        match body.encoder.encode(seen.state) {
            Ok(Some(frame)) => {
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
        if self.options.hands {
            self.hands.push(hand);
        }
    }

    /// After all bodies and hands of a tick.
    pub(crate) fn finish(&mut self, tick: Tick, numbers: WatchNumbers) {
        let gone: Vec<BodyId> = self.bodies.iter().filter(|(_, b)| !b.seen).map(|(id, _)| *id).collect();
        for id in gone {
            let Some(body) = self.bodies.remove(&id) else { continue };
            let model = body.entry.model;
            let alone = self.bodies.values().all(|other| other.entry.model != model);
            self.gone.push((id, alone.then_some(model)));
            self.catalog_sent = false;
        }
        // What the thread has no room for waits for the next tick.
        while let Some((id, model)) = self.gone.pop() {
            if self.queue.try_send(Item::Gone(id, model)).is_err() {
                self.gone.push((id, model));
                break;
            }
        }
        self.bodies.values_mut().for_each(|body| body.seen = false);
        if !self.catalog_sent {
            let catalog = Catalog {
                session: self.session,
                step: self.step,
                name: self.options.title.clone(),
                bodies: self.bodies.values().map(|body| body.entry.clone()).collect(),
                cameras: self.options.cameras.clone(),
            };
            let bytes = catalog.encode();
            let length = bytes.len();
            self.catalog_sent = self.send(Item::Catalog(tick, bytes), length);
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

/// A track of frames in groups.
struct Line {
    track: track::Producer,
    group: Option<group::Producer>,
}

impl Line {
    fn new(broadcast: &broadcast::Producer, name: String) -> Result<Self, moq_net::Error> {
        let info = track::Info::default().with_max_age(KEEP);
        Ok(Self { track: broadcast.create_track(name, info)?, group: None })
    }

    fn write(&mut self, begins: bool, time: Timestamp, bytes: Vec<u8>) -> Result<(), moq_net::Error> {
        if begins {
            if let Some(group) = self.group.take() {
                group.finish()?;
            }
            self.group = Some(self.track.append_group()?);
        }
        match &mut self.group {
            Some(group) => group.write_frame(time, bytes),
            None => Ok(()),
        }
    }

    fn finish(mut self) {
        if let Some(group) = self.group.take() {
            let _ = group.finish();
        }
        let _ = self.track.finish();
    }
}

/// Carries what the host publishes to the relay, until the host drops its end of the queue.
async fn carry(
    relay: Relay,
    name: String,
    mut items: Receiver<Item>,
    shared: Arc<Shared>,
    step: f64,
) -> Result<(), moq_net::Error> {
    let (producer, driver) = origin::Producer::new(origin::Config::default());
    tokio::task::spawn_local(moq_net::time::run(driver));
    let broadcast = producer.create_broadcast(name.as_str())?;
    let mut requests = broadcast.dynamic();
    let mut catalog = Line::new(&broadcast, CATALOG_TRACK.into())?;
    let mut hands = Line::new(&broadcast, HANDS_TRACK.into())?;
    let mut bodies: BTreeMap<BodyId, Line> = BTreeMap::new();
    let mut models: BTreeMap<ModelHash, (Arc<ModalModel>, usize)> = BTreeMap::new();
    let client = moq_net::Client::new().with_publisher(&producer);
    let stats = shared.clone();
    let connection = tokio::task::spawn_local(async move {
        relay
            .keep(client, move |connected| {
                stats.connected.store(connected, Ordering::Relaxed);
                stats.connections.fetch_add(u64::from(connected), Ordering::Relaxed);
            })
            .await;
    });
    let mut announced = false;
    let mut hand_frames = 0_u64;
    loop {
        let item = tokio::select! {
            item = items.recv() => item,
            request = requests.requested_track() => {
                if let Ok(request) = request {
                    serve(request, &models);
                }
                continue;
            }
        };
        let Some(item) = item else { break };
        match item {
            Item::Catalog(tick, bytes) => {
                catalog.write(true, time_of(tick, step), bytes)?;
                if !announced {
                    broadcast.announce(origin::Route::default())?;
                    announced = true;
                }
            }
            Item::Model(model, modes) => {
                models.insert(model.hash(), (model, modes));
            }
            Item::Frame(body, tick, begins, bytes) => {
                let line = match bodies.entry(body) {
                    std::collections::btree_map::Entry::Occupied(line) => line.into_mut(),
                    std::collections::btree_map::Entry::Vacant(place) => {
                        place.insert(Line::new(&broadcast, body_track(body))?)
                    }
                };
                line.write(begins, time_of(tick, step), bytes)?;
            }
            Item::Hands(tick, bytes) => {
                // A watcher that comes late waits for nothing here: each frame stands alone.
                let begins = hand_frames.is_multiple_of(32);
                hand_frames += 1;
                hands.write(begins, time_of(tick, step), bytes)?;
            }
            Item::Gone(body, model) => {
                if let Some(model) = model {
                    models.remove(&model);
                }
                if let Some(line) = bodies.remove(&body) {
                    line.finish();
                }
            }
        }
    }
    // The session is over: all watchers get its end, if the relay is there.
    bodies.into_values().for_each(Line::finish);
    hands.finish();
    catalog.finish();
    broadcast.close();
    tokio::time::sleep(GOODBYE / 2).await;
    connection.abort();
    Ok(())
}

fn time_of(tick: Tick, step: f64) -> Timestamp {
    // Below 2^53 milliseconds, which is within what a timestamp holds.
    let millis = (tick as f64 * step * 1e3).clamp(0.0, 9e15) as u64;
    Timestamp::from_millis(millis).unwrap_or(Timestamp::ZERO)
}

/// Answers a request for a model or a surface, which are made when somebody wants them.
fn serve(request: track::Request, models: &BTreeMap<ModelHash, (Arc<ModalModel>, usize)>) {
    let found = models.iter().find_map(|(hash, (model, modes))| {
        let name = request.name();
        let surface = name == surface_track(*hash);
        (surface || name == model_track(*hash)).then(|| (model.clone(), *modes, surface))
    });
    let Some((model, modes, surface)) = found else {
        request.reject(moq_net::Error::NotFound);
        return;
    };
    tokio::task::spawn_local(async move {
        let made = tokio::task::spawn_blocking(move || {
            if surface { WatchSurface::new(&model, modes).encode() } else { model.to_bytes() }
        });
        let Ok(bytes) = made.await else {
            request.reject(moq_net::Error::NotFound);
            return;
        };
        let track = request.accept(track::Info::default());
        let write = || -> Result<(), moq_net::Error> {
            let mut group = track.append_group()?;
            for piece in pieces(&bytes) {
                group.write_frame(Timestamp::ZERO, piece.to_vec())?;
            }
            group.finish()
        };
        if let Err(error) = write() {
            tracing::debug!("a model was not published: {error}");
        }
        // The track stays as long as somebody reads it, and is asked for again after that. It does
        // not end before: the library of browsers drops a group that comes after the track's end,
        // and the two are on streams of their own. Who asks reads a moment later.
        tokio::time::sleep(KEEP).await;
        let _ = track.unused().await;
        let _ = track.finish();
    });
}

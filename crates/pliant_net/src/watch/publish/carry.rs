//! The thread that carries what a host publishes to the relay.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use moq_net::{Timestamp, broadcast, group, origin, track};
use pliant_modal::{ModalModel, ModelHash};
use pliant_stream::watch::{
    CATALOG_TRACK, HANDS_TRACK, WatchSurface, body_track, model_track, pieces, surface_track,
};
use pliant_stream::{BodyId, Tick};
use tokio::sync::OnceCell;
use tokio::sync::mpsc::Receiver;

use super::super::relay::Relay;
use super::{GOODBYE, Item, Shared};

/// How long a relay keeps a group beside the newest.
const KEEP: Duration = Duration::from_secs(3);

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
pub(super) async fn carry(
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
    let mut models: BTreeMap<ModelHash, Rc<PublishedModel>> = BTreeMap::new();
    let client = moq_net::Client::new().with_publisher(&producer);
    let stats = shared.clone();
    let connection = tokio::task::spawn_local(async move {
        relay
            .keep(client, move |connection| {
                stats.connected.store(connection.is_ok(), Ordering::Relaxed);
                stats.connections.fetch_add(u64::from(connection.is_ok()), Ordering::Relaxed);
                if let Err(why) = connection {
                    *stats.relay_error.lock().unwrap_or_else(PoisonError::into_inner) = why;
                }
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
            Item::Model(model, modes, file) => {
                // Several bodies may have it.
                let made = |model| Rc::new(PublishedModel { model, modes, file, bytes: Default::default() });
                models.entry(model.hash()).or_insert_with(|| made(model));
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

/// A model that watchers may ask for.
struct PublishedModel {
    model: Arc<ModalModel>,
    modes: usize,
    /// Whether they may ask for its file.
    file: bool,
    /// Its file and its surface, made when somebody wants them for the first time.
    bytes: [OnceCell<Arc<Vec<u8>>>; 2],
}

impl PublishedModel {
    async fn bytes(&self, surface: bool) -> Option<Arc<Vec<u8>>> {
        let make = || async {
            let (model, modes) = (self.model.clone(), self.modes);
            // A large model takes longer than frames may wait.
            let made = tokio::task::spawn_blocking(move || match surface {
                true => WatchSurface::new(&model, modes).encode(),
                false => model.to_bytes(),
            });
            made.await.map(Arc::new)
        };
        self.bytes[usize::from(surface)].get_or_try_init(make).await.ok().cloned()
    }
}

/// Answers a request for a model or a surface.
fn serve(request: track::Request, models: &BTreeMap<ModelHash, Rc<PublishedModel>>) {
    let found = models.iter().find_map(|(hash, model)| {
        let name = request.name();
        let surface = name == surface_track(*hash);
        (surface || model.file && name == model_track(*hash)).then(|| (model.clone(), surface))
    });
    let Some((model, surface)) = found else {
        request.reject(moq_net::Error::NotFound);
        return;
    };
    tokio::task::spawn_local(async move {
        let Some(bytes) = model.bytes(surface).await else {
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

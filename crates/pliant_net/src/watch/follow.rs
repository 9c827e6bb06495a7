//! The watcher's side without an engine: follows a session at a relay.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use moq_net::{broadcast, origin, track};
use pliant_modal::{ModalModel, ModelHash};
use pliant_stream::BodyId;
use pliant_stream::watch::{
    Assembler, BodyDecoder, CATALOG_TRACK, Catalog, CatalogBody, HANDS_TRACK, MAX_FRAME, MAX_MODEL,
    WatchHands, WatchedState, body_track, coordinate_steps, model_track,
};
use tokio::sync::OnceCell;
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tokio::task::AbortHandle;

use super::relay::{Relay, RelayOptions, WatchError};

/// Events that wait for the app. While they are full, nothing more is read from the relay.
const QUEUE: usize = 1024;
/// Most bytes of the models of one session, as files.
const MODELS: u64 = 256 << 20;
/// How long an older group is waited for, where a newer one is there. Who comes late gets a group
/// that ended within this time first.
const PATIENCE: Duration = Duration::from_millis(300);
/// Pause before a track that has ended is asked for again.
const RETRY_PAUSE: Duration = Duration::from_millis(500);

/// What happens in a session that is watched.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum WatchEvent {
    /// The relay is connected, or is lost and tried again.
    Relay(bool),
    /// Why the relay was lost or not reached. One that refuses a token is connected and lost at
    /// once.
    RelayError(String),
    /// The host's session is there, with another catalog than before. A body in it may look
    /// different from before, or be somewhere else.
    Catalog(Catalog),
    /// A body has its model.
    Body(CatalogBody, Arc<ModalModel>),
    /// A frame of a body that has its model.
    State(BodyId, WatchedState),
    /// The catalog has a body no longer.
    Gone(BodyId),
    /// Hands and numbers.
    Hands(WatchHands),
    /// The host's session is over, or its relay has lost it. It is waited for.
    Over,
    /// The relay or the host has sent something that is wrong. It was left out.
    Wrong(String),
}

/// Follows a session at a relay, until it is dropped. Relays and hosts that come again are found
/// again. Nothing is ever sent to the host.
pub struct Watcher {
    events: Receiver<WatchEvent>,
}

impl Watcher {
    /// Begins to follow. `known` are models that need not be fetched.
    ///
    /// # Errors
    /// [`WatchError`] for a relay's address or a session's name that is none.
    pub fn open(options: &RelayOptions, known: Vec<Arc<ModalModel>>) -> Result<Self, WatchError> {
        let (watcher, followed) = Self::of(options)?;
        start(vec![followed], known)?;
        Ok(watcher)
    }

    /// Follows several sessions, or one several times, on one thread: what hundreds of watchers in
    /// a process need. None waits for another, as long as their events are read.
    ///
    /// # Errors
    /// As [`open`](Self::open), for the first address or name that is none.
    pub fn open_all(sessions: &[RelayOptions], known: Vec<Arc<ModalModel>>) -> Result<Vec<Self>, WatchError> {
        let all = sessions.iter().map(Self::of).collect::<Result<Vec<_>, _>>()?;
        let (watchers, followed) = all.into_iter().unzip();
        start(followed, known)?;
        Ok(watchers)
    }

    fn of(options: &RelayOptions) -> Result<(Self, Followed), WatchError> {
        let (to, events) = channel(QUEUE);
        Ok((Self { events }, Followed { relay: options.open()?, name: options.session.clone(), to }))
    }

    /// The next event, if there is one.
    pub fn poll(&mut self) -> Option<WatchEvent> {
        self.events.try_recv().ok()
    }
}

/// A session at a relay, and who is told of it.
struct Followed {
    relay: Relay,
    name: String,
    to: Sender<WatchEvent>,
}

/// Follows sessions on a thread of their own, each until its watcher is dropped.
fn start(sessions: Vec<Followed>, known: Vec<Arc<ModalModel>>) -> Result<(), WatchError> {
    let setup = |error: std::io::Error| WatchError::Setup(error.to_string());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(setup)?;
    let run = move || {
        let tasks = tokio::task::LocalSet::new();
        let followed = sessions.into_iter().map(|Followed { relay, name, to }| {
            let (known, closed) = (known.clone(), to.clone());
            tasks.spawn_local(async move {
                tokio::select! {
                    () = follow(relay, name, known, to) => {}
                    () = closed.closed() => {}
                }
            })
        });
        let followed: Vec<_> = followed.collect();
        runtime.block_on(tasks.run_until(async move {
            for one in followed {
                let _ = one.await;
            }
        }));
        drop(tasks);
        runtime.shutdown_timeout(Duration::from_millis(500));
    };
    thread::Builder::new().name("pliant-watcher".into()).spawn(run).map_err(setup)?;
    Ok(())
}

/// A task that ends with its owner.
struct Owned(AbortHandle);

impl Owned {
    fn spawn(task: impl Future<Output = ()> + 'static) -> Self {
        Self(tokio::task::spawn_local(task).abort_handle())
    }
}

impl Drop for Owned {
    fn drop(&mut self) {
        self.0.abort();
    }
}

struct FollowedBody {
    body: CatalogBody,
    _task: Owned,
}

/// What the tasks of a broadcast share.
#[derive(Clone)]
struct FollowedScene {
    broadcast: broadcast::Consumer,
    to: Sender<WatchEvent>,
    models: Models,
}

/// The models that are there or are being fetched.
#[derive(Clone, Default)]
struct Models(Rc<RefCell<BTreeMap<ModelHash, FetchedModel>>>);

#[derive(Default)]
struct FetchedModel {
    model: Rc<OnceCell<Arc<ModalModel>>>,
    /// Length of the file. 0 for one that was known before.
    bytes: u64,
    /// Number of bodies that have it.
    users: usize,
}

/// A body's part in a model.
struct UsedModel {
    models: Models,
    hash: ModelHash,
}

impl Models {
    /// The model of a body, there or not, for as long as what is returned is kept. Models that
    /// nobody uses make room.
    fn of_body(&self, body: &CatalogBody) -> Result<UsedModel, String> {
        let mut models = self.0.borrow_mut();
        if !models.contains_key(&body.model) {
            if body.file_bytes == 0 {
                return Err("the host does not publish the files of its models".into());
            }
            if body.file_bytes > MAX_MODEL as u64 {
                return Err("a model is too large".into());
            }
            let mut sum = models.values().fold(body.file_bytes, |sum, model| sum.saturating_add(model.bytes));
            models.retain(|_, model| {
                let goes = sum > MODELS && model.users == 0 && model.bytes > 0;
                sum -= if goes { model.bytes } else { 0 };
                !goes
            });
            if sum > MODELS {
                return Err("the session has too many models".into());
            }
            models.insert(body.model, FetchedModel { bytes: body.file_bytes, ..FetchedModel::default() });
        }
        let users = models.get_mut(&body.model).map(|model| &mut model.users);
        users.into_iter().for_each(|users| *users += 1);
        Ok(UsedModel { models: self.clone(), hash: body.model })
    }
}

impl UsedModel {
    /// The model and the length of its file.
    fn model(&self) -> (Rc<OnceCell<Arc<ModalModel>>>, u64) {
        let models = self.models.0.borrow();
        models.get(&self.hash).map(|one| (one.model.clone(), one.bytes)).unwrap_or_default()
    }
}

impl Drop for UsedModel {
    fn drop(&mut self) {
        let mut models = self.models.0.borrow_mut();
        let Some(model) = models.get_mut(&self.hash) else { return };
        model.users -= 1;
        // One that is there is kept for when the host starts again, while there is room.
        if model.users == 0 && model.model.get().is_none() {
            models.remove(&self.hash);
        }
    }
}

async fn follow(relay: Relay, name: String, known: Vec<Arc<ModalModel>>, to: Sender<WatchEvent>) {
    let (producer, driver) = origin::Producer::new(origin::Config::default());
    let _driver = Owned::spawn(async move { drop(moq_net::time::run(driver).await) });
    let client = moq_net::Client::new().with_subscriber(producer.clone());
    let events = to.clone();
    let _connection = Owned::spawn(async move {
        // An app that does not read learns of the relay from what arrives.
        let on_change = move |connection: Result<(), String>| {
            drop(events.try_send(WatchEvent::Relay(connection.is_ok())));
            if let Err(why) = connection {
                drop(events.try_send(WatchEvent::RelayError(why)));
            }
        };
        relay.keep(client, on_change).await;
    });
    let models = Models::default();
    for model in known {
        let (hash, model) = (model.hash(), Rc::new(OnceCell::new_with(Some(model))));
        models.0.borrow_mut().insert(hash, FetchedModel { model, ..FetchedModel::default() });
    }
    let consumer = producer.consume();
    while let Ok(broadcast) = consumer.routed_broadcast(name.as_str()).await {
        let scene = FollowedScene { broadcast: broadcast.clone(), to: to.clone(), models: models.clone() };
        tokio::select! {
            _ = broadcast.closed() => {}
            () = scene.follow() => {}
        }
        if to.send(WatchEvent::Over).await.is_err() {
            break;
        }
    }
}

impl FollowedScene {
    /// Follows the catalog, and with it the bodies, until the app is gone.
    async fn follow(&self) {
        let _hands = Owned::spawn(self.clone().follow_hands());
        let mut bodies: BTreeMap<BodyId, FollowedBody> = BTreeMap::new();
        let mut session = None;
        loop {
            if let Ok(mut track) = self.subscribe(CATALOG_TRACK, 3).await {
                while let Ok(Some(mut group)) = track.next_group().await {
                    let Ok(Some(frame)) = group.read_frame().await else { continue };
                    match checked(&frame.payload).and_then(|bytes| decoded(Catalog::decode(bytes))) {
                        Ok(catalog) => {
                            // A relay that has lost the host may go on with another start of it.
                            let new = Some((catalog.session, catalog.step.to_bits()));
                            if std::mem::replace(&mut session, new) != new {
                                for id in std::mem::take(&mut bodies).into_keys() {
                                    self.send(WatchEvent::Gone(id)).await;
                                }
                            }
                            self.take(catalog, &mut bodies).await;
                        }
                        Err(wrong) => self.send(WatchEvent::Wrong(wrong)).await,
                    }
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }

    async fn take(&self, catalog: Catalog, bodies: &mut BTreeMap<BodyId, FollowedBody>) {
        let stays = |body: &CatalogBody| catalog.bodies.iter().any(|new| body.goes_on_as(new));
        let gone: Vec<BodyId> = bodies.iter().filter(|(_, f)| !stays(&f.body)).map(|(id, _)| *id).collect();
        for id in gone {
            bodies.remove(&id);
            if !catalog.bodies.iter().any(|body| body.id == id) {
                self.send(WatchEvent::Gone(id)).await;
            }
        }
        let new = catalog.bodies.iter().filter(|body| !bodies.contains_key(&body.id)).cloned();
        let new: Vec<CatalogBody> = new.collect();
        self.send(WatchEvent::Catalog(catalog)).await;
        for body in new {
            let _task = Owned::spawn(self.clone().follow_body(body.clone()));
            bodies.insert(body.id, FollowedBody { body, _task });
        }
    }

    async fn follow_hands(self) {
        loop {
            if let Ok(mut track) = self.subscribe(HANDS_TRACK, 1).await {
                while let Ok(Some(mut group)) = track.next_group().await {
                    while let Ok(Some(frame)) = group.read_frame().await {
                        match checked(&frame.payload).and_then(|bytes| decoded(WatchHands::decode(bytes))) {
                            Ok(hands) => self.send(WatchEvent::Hands(hands)).await,
                            Err(wrong) => {
                                self.send(WatchEvent::Wrong(wrong)).await;
                                break;
                            }
                        }
                    }
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }

    async fn follow_body(self, body: CatalogBody) {
        // Dropped with this task, when the body is gone.
        let (_used, model) = loop {
            match self.model(&body).await {
                Ok(used) => break used,
                Err(wrong) => self.send(WatchEvent::Wrong(wrong)).await,
            }
            tokio::time::sleep(4 * RETRY_PAUSE).await;
        };
        let mut decoder = BodyDecoder::new(coordinate_steps(&model, usize::from(body.modes)));
        self.send(WatchEvent::Body(body.clone(), model)).await;
        let name = body_track(body.id);
        loop {
            if let Ok(mut track) = self.subscribe(&name, 2).await {
                while let Ok(Some(mut group)) = track.next_group().await {
                    while let Ok(Some(frame)) = group.read_frame().await {
                        let state = checked(&frame.payload).and_then(|bytes| decoded(decoder.decode(bytes)));
                        match state {
                            Ok((_, state)) => {
                                let state = state.clone();
                                self.send(WatchEvent::State(body.id, state)).await;
                            }
                            Err(wrong) => {
                                // The group is over; the next one begins anew.
                                self.send(WatchEvent::Wrong(wrong)).await;
                                break;
                            }
                        }
                    }
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }

    /// The model of a body, fetched once for all bodies that have it.
    async fn model(&self, body: &CatalogBody) -> Result<(UsedModel, Arc<ModalModel>), String> {
        let used = self.models.of_body(body)?;
        let (place, bytes) = used.model();
        let model = place.get_or_try_init(|| self.fetch(body.model, bytes)).await?.clone();
        Ok((used, model))
    }

    async fn fetch(&self, hash: ModelHash, bytes: u64) -> Result<Arc<ModalModel>, String> {
        let mut assembler = decoded(Assembler::new(bytes, MAX_MODEL))?;
        let mut track = self.subscribe(&model_track(hash), 0).await.map_err(|e| e.to_string())?;
        let group = track.next_group().await.map_err(|error| error.to_string())?;
        let mut group = group.ok_or("a model's track is empty")?;
        while let Some(frame) = group.read_frame().await.map_err(|error| error.to_string())? {
            let Some(bytes) = decoded(assembler.push(checked(&frame.payload)?))? else { continue };
            // A large model takes longer to read than frames may wait.
            let read = tokio::task::spawn_blocking(move || ModalModel::from_bytes(&bytes)).await;
            let model = read.map_err(|error| error.to_string())?.map_err(|error| error.to_string())?;
            if model.hash() != hash {
                return Err("a model is another one than the catalog says".into());
            }
            return Ok(Arc::new(model));
        }
        Err("a model was cut off".into())
    }

    async fn subscribe(&self, name: &str, priority: u8) -> Result<track::Ordered, moq_net::Error> {
        let wanted = track::Subscription::default().with_priority(priority).with_max_age(PATIENCE);
        Ok(self.broadcast.track(name)?.subscribe(wanted).await?.ordered())
    }

    async fn send(&self, event: WatchEvent) {
        // The thread ends when the app is gone.
        let _ = self.to.send(event).await;
    }
}

fn checked(payload: &[u8]) -> Result<&[u8], String> {
    if payload.len() <= MAX_FRAME { Ok(payload) } else { Err("a frame is too long".into()) }
}

fn decoded<T>(result: Result<T, pliant_stream::StreamError>) -> Result<T, String> {
    result.map_err(|error| error.to_string())
}

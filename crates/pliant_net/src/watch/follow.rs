//! The watcher's side without an engine: follows a session at a relay.

use std::cell::{Cell, RefCell};
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
/// Most bytes of models of one session.
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
    /// The host's session is there, with another catalog than before.
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
    /// The relay or the host has sent what is none. It was left out.
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
struct Scene {
    broadcast: broadcast::Consumer,
    to: Sender<WatchEvent>,
    models: Rc<RefCell<BTreeMap<ModelHash, Rc<OnceCell<Arc<ModalModel>>>>>>,
    /// Bytes of models that were fetched or are being fetched.
    fetched: Rc<Cell<u64>>,
}

async fn follow(relay: Relay, name: String, known: Vec<Arc<ModalModel>>, to: Sender<WatchEvent>) {
    let (producer, driver) = origin::Producer::new(origin::Config::default());
    let _driver = Owned::spawn(async move { drop(moq_net::time::run(driver).await) });
    let client = moq_net::Client::new().with_subscriber(producer.clone());
    let events = to.clone();
    let _connection = Owned::spawn(async move {
        // An app that does not read learns of the relay from what arrives.
        relay.keep(client, move |connected| drop(events.try_send(WatchEvent::Relay(connected)))).await;
    });
    let models = known.into_iter().map(|model| (model.hash(), Rc::new(OnceCell::new_with(Some(model)))));
    let models = Rc::new(RefCell::new(models.collect::<BTreeMap<_, _>>()));
    let consumer = producer.consume();
    while let Ok(broadcast) = consumer.routed_broadcast(name.as_str()).await {
        let (models, fetched) = (models.clone(), Rc::new(Cell::new(0)));
        let scene = Scene { broadcast: broadcast.clone(), to: to.clone(), models, fetched };
        tokio::select! {
            _ = broadcast.closed() => {}
            () = scene.follow() => {}
        }
        if to.send(WatchEvent::Over).await.is_err() {
            break;
        }
    }
}

impl Scene {
    /// Follows the catalog, and with it the bodies, until the app is gone.
    async fn follow(&self) {
        let _hands = Owned::spawn(self.clone().follow_hands());
        let mut bodies: BTreeMap<BodyId, FollowedBody> = BTreeMap::new();
        loop {
            if let Ok(mut track) = self.subscribe(CATALOG_TRACK, 3).await {
                while let Ok(Some(mut group)) = track.next_group().await {
                    let Ok(Some(frame)) = group.read_frame().await else { continue };
                    match checked(&frame.payload).and_then(|bytes| decoded(Catalog::decode(bytes))) {
                        Ok(catalog) => self.take(catalog, &mut bodies).await,
                        Err(wrong) => self.send(WatchEvent::Wrong(wrong)).await,
                    }
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }

    async fn take(&self, catalog: Catalog, bodies: &mut BTreeMap<BodyId, FollowedBody>) {
        let stays = |body: &CatalogBody| catalog.bodies.iter().any(|new| new == body);
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
        let model = loop {
            match self.model(&body).await {
                Ok(model) => break model,
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
    async fn model(&self, body: &CatalogBody) -> Result<Arc<ModalModel>, String> {
        let place = self.models.borrow_mut().entry(body.model).or_default().clone();
        let model = place.get_or_try_init(|| self.fetch(body)).await?;
        Ok(model.clone())
    }

    async fn fetch(&self, body: &CatalogBody) -> Result<Arc<ModalModel>, String> {
        if body.file_bytes == 0 {
            return Err("the host does not publish the files of its models".into());
        }
        let sum = self.fetched.get().saturating_add(body.file_bytes);
        if sum > MODELS {
            return Err("the session has too many models".into());
        }
        let mut assembler = decoded(Assembler::new(body.file_bytes, MAX_MODEL))?;
        self.fetched.set(sum);
        let mut track = self.subscribe(&model_track(body.model), 0).await.map_err(|e| e.to_string())?;
        let group = track.next_group().await.map_err(|error| error.to_string())?;
        let mut group = group.ok_or("a model's track is empty")?;
        while let Some(frame) = group.read_frame().await.map_err(|error| error.to_string())? {
            let Some(bytes) = decoded(assembler.push(checked(&frame.payload)?))? else { continue };
            // A large model takes longer to read than frames may wait.
            let read = tokio::task::spawn_blocking(move || ModalModel::from_bytes(&bytes)).await;
            let model = read.map_err(|error| error.to_string())?.map_err(|error| error.to_string())?;
            if model.hash() != body.model {
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

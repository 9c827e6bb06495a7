//! The app's session: begun, left, and begun again while the app runs.
//!
//! Commands only leave a request, which [`follow`] takes up in `PreUpdate`. A session is therefore
//! never taken out of the world while one of its own systems has it.

use std::sync::mpsc::{Receiver, SendError, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use bevy::prelude::*;
use pliant_body::{BodyState, Driven, FixedObstacles, VisualState};
use pliant_modal::{Body, Frame, State, StepError};
use pliant_stream::{DisconnectReason, UserId};

use crate::guest::{self, GuestState, JoinConfig, NetGuest};
use crate::host::{self, HostConfig, NetHost};
use crate::peer::{self, NetPeer, PeerConfig, PeerState};
use crate::plugin::NetError;
use crate::recording::SessionRecording;
use crate::remote::{
    BodyArrived, BodyLeft, GrabRefused, RemoteBody, RemoteHands, RigidArrived, RigidLeft, SessionClosed,
    SessionFailed, SessionJoined, SessionLost,
};
use crate::transport::{Carrier, Endpoint, Invite, MeshCarrier, TransportError, quic};
use crate::user::{UserJoined, UserLeft};

/// Begins and leaves sessions while the app runs. The app needs a
/// [`NetPlugin`](crate::NetPlugin), which may begin without a session.
///
/// A command takes effect in the next `PreUpdate`, and no frame waits for it: sockets are opened
/// and closed on threads. A session that the app is in, or is about to join, is left first. What
/// becomes of the session is in [`SessionState`] and in the events [`SessionJoined`],
/// [`SessionLost`], [`SessionClosed`] and [`SessionFailed`].
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_net::{HostConfig, JoinConfig, SessionCommands, SessionFailed};
/// # let (host, pasted) = (true, "");
/// # let menu = move |mut commands: Commands| {
/// if host {
///     commands.host_session(HostConfig::default());
/// } else {
///     commands.join_session(pasted, JoinConfig::default());
/// }
/// # };
/// fn report(failed: On<SessionFailed>) {
///     println!("{}", failed.reason);
/// }
/// ```
pub trait SessionCommands {
    /// Hosts a session. The state is [`SessionState::Hosting`] when the socket is open, and the
    /// invite is then [`NetHost::invite`].
    ///
    /// The port of a session that was left just before can be used again at once, even while that
    /// session still says goodbye.
    fn host_session(&mut self, config: HostConfig);

    /// Joins the session of an invite, which may be the text of one.
    fn join_session<I>(&mut self, invite: I, config: JoinConfig)
    where
        I: TryInto<Invite>,
        I::Error: Into<NetError>;

    /// Hosts a session over a carrier of the app's own, such as [`CarrierPort::host`] makes.
    ///
    /// [`CarrierPort::host`]: crate::transport::CarrierPort::host
    fn host_session_over(&mut self, carrier: impl Carrier, config: HostConfig);

    /// Joins the session at the other end of a carrier of the app's own, such as
    /// [`CarrierPort::join`] makes.
    ///
    /// [`CarrierPort::join`]: crate::transport::CarrierPort::join
    fn join_session_over(&mut self, carrier: impl Carrier, config: JoinConfig);

    /// Plays among peers: joins those of [`PeerConfig::join`], or is the first of a new session.
    fn join_peers(&mut self, config: PeerConfig);

    /// Plays among peers over a carrier of the app's own, such as [`CarrierPort::mesh`] makes:
    /// joins the peer of [`PeerConfig::join`] ([`CarrierPort::invite_of`]), or is the first of a
    /// new session. The rest of [`PeerConfig::transport`] but its limits is not used.
    ///
    /// [`CarrierPort::mesh`]: crate::transport::CarrierPort::mesh
    /// [`CarrierPort::invite_of`]: crate::transport::CarrierPort::invite_of
    fn join_peers_over(&mut self, carrier: impl MeshCarrier, config: PeerConfig);

    /// Plays a recorded session, as [`NetPlugin::replay`](crate::NetPlugin::replay) does.
    fn replay_session(&mut self, recording: SessionRecording, config: JoinConfig);

    /// Leaves the session, or ends it for everybody where this app hosts it. The others get a
    /// goodbye. Without a session nothing happens.
    ///
    /// The users and all other users' hands are despawned. Bodies of a host go on. Bodies that the
    /// session has spawned on a guest are despawned. An entity of the app that a guest or a peer
    /// has shared keeps what it had before: its [`ModalBody`](pliant_body::ModalBody) is stepped
    /// here again, from the shape in which it was last displayed and from rest. If it had none, it
    /// loses the one that the session gave to it.
    fn leave_session(&mut self);
}

impl SessionCommands for Commands<'_, '_> {
    fn host_session(&mut self, config: HostConfig) {
        self.queue(ask(Request::open(|| open_host(config))));
    }

    fn join_session<I>(&mut self, invite: I, config: JoinConfig)
    where
        I: TryInto<Invite>,
        I::Error: Into<NetError>,
    {
        let invite = invite.try_into().map_err(Into::into);
        self.queue(ask(match invite {
            Ok(invite) => Request::open(move || open_guest(&invite, config)),
            Err(error) => Request::Fail(error),
        }));
    }

    fn host_session_over(&mut self, carrier: impl Carrier, config: HostConfig) {
        let opened = Opened::Host(Box::new(config), Box::new(carrier));
        self.queue(ask(Request::Begin(opened)));
    }

    fn join_session_over(&mut self, carrier: impl Carrier, config: JoinConfig) {
        // On a thread, because the file of a recording is created.
        self.queue(ask(Request::open(move || open_guest_over(Box::new(carrier), config))));
    }

    fn join_peers(&mut self, config: PeerConfig) {
        self.queue(ask(Request::open(|| open_peer(config))));
    }

    fn join_peers_over(&mut self, carrier: impl MeshCarrier, config: PeerConfig) {
        let peer = NetPeer::open_over(Box::new(carrier), config);
        self.queue(ask(match peer {
            Ok(peer) => Request::Begin(Opened::Peer(Box::new(peer))),
            Err(error) => Request::Fail(error.into()),
        }));
    }

    fn replay_session(&mut self, recording: SessionRecording, config: JoinConfig) {
        self.queue(ask(Request::Begin(open_replay(recording, config))));
    }

    fn leave_session(&mut self) {
        self.queue(ask(Request::Leave));
    }
}

/// Where the app stands with its session.
///
/// A resource, for `resource_equals` and change detection. With the feature `states` it is a state
/// as well: an app with `init_state::<SessionState>()` has `OnEnter` and `in_state` of it, one
/// frame later than the resource.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "states", derive(States))]
#[reflect(Resource, Debug, Default, Clone, PartialEq, Hash)]
pub enum SessionState {
    /// There is no session, or it is over. What it displayed stays until the app leaves it or
    /// begins another one. Default.
    #[default]
    Idle,
    /// The socket is being opened.
    Opening,
    /// The host, or the first peer, has not admitted this app yet.
    Joining,
    /// This app hosts the session.
    Hosting,
    /// This app is in the session, as a guest or among peers.
    Joined,
    /// A guest has lost its host and tries to join again.
    Lost,
}

/// A session whose sockets are open.
pub(crate) enum Opened {
    Host(Box<HostConfig>, Box<dyn Carrier>),
    Guest(Box<NetGuest>),
    Peer(Box<NetPeer>),
}

impl Opened {
    /// Returns the invite to this host or peer.
    pub(crate) fn invite(&self) -> Option<Invite> {
        match self {
            Self::Host(_, carrier) => quic(&**carrier).map(Endpoint::invite),
            Self::Guest(_) => None,
            Self::Peer(peer) => Some(peer.invite()),
        }
    }

    /// Leaves the ports to the next session.
    fn end(&self) {
        match self {
            Self::Host(_, carrier) => carrier.end(),
            Self::Guest(guest) => guest.end_connection(),
            Self::Peer(peer) => peer.end_connections(),
        }
    }
}

pub(crate) fn open_host(mut config: HostConfig) -> Result<Opened, NetError> {
    let endpoint = Endpoint::host(std::mem::take(&mut config.transport))?;
    Ok(Opened::Host(Box::new(config), Box::new(endpoint)))
}

pub(crate) fn open_guest(invite: &Invite, mut config: JoinConfig) -> Result<Opened, NetError> {
    let limits = config.transport.limits.clone();
    let endpoint = Endpoint::join(invite, std::mem::take(&mut config.transport))?;
    config.transport.limits = limits;
    open_guest_over(Box::new(endpoint), config)
}

fn open_guest_over(carrier: Box<dyn Carrier>, config: JoinConfig) -> Result<Opened, NetError> {
    Ok(Opened::Guest(Box::new(NetGuest::join(config, carrier)?)))
}

pub(crate) fn open_peer(config: PeerConfig) -> Result<Opened, NetError> {
    Ok(Opened::Peer(Box::new(NetPeer::open(config)?)))
}

pub(crate) fn open_replay(recording: SessionRecording, mut config: JoinConfig) -> Opened {
    config.models.extend(recording.models.iter().cloned());
    Opened::Guest(Box::new(NetGuest::replay(config, recording)))
}

type Open = Box<dyn FnOnce() -> Result<Opened, NetError> + Send + Sync>;

/// What the app has asked for.
enum Request {
    /// Begin with open sockets.
    Begin(Opened),
    /// Open the sockets on a thread.
    Open(Open),
    /// Report that the session cannot begin.
    Fail(NetError),
    Leave,
}

impl Request {
    fn open(open: impl FnOnce() -> Result<Opened, NetError> + Send + Sync + 'static) -> Self {
        Self::Open(Box::new(open))
    }
}

fn ask(request: Request) -> impl FnOnce(&mut World) {
    move |world: &mut World| match world.get_resource_mut::<SessionControl>() {
        Some(mut control) => control.requests.push(request),
        None => error!("there is no session without a NetPlugin: `app.add_plugins(NetPlugin::default())`"),
    }
}

/// An event of a session, for messages and observers.
pub(crate) enum SessionEvent {
    Joined(SessionJoined),
    Lost(SessionLost),
    Closed(SessionClosed),
    Failed(SessionFailed),
    BodyArrived(BodyArrived),
    BodyLeft(BodyLeft),
    RigidArrived(RigidArrived),
    RigidLeft(RigidLeft),
    GrabRefused(GrabRefused),
    UserJoined(UserJoined),
    UserLeft(UserLeft),
}

impl SessionEvent {
    pub(crate) fn failed(error: NetError) -> Self {
        Self::Failed(SessionFailed { reason: Arc::new(error) })
    }

    /// The end of a session for this app. `inside`: the app was in it.
    pub(crate) fn over(inside: bool, reason: DisconnectReason) -> Self {
        if inside {
            Self::Closed(SessionClosed { reason })
        } else {
            Self::failed(NetError::NotJoined(reason))
        }
    }
}

/// The changes of the session that are under way.
#[derive(Resource, Default)]
pub(crate) struct SessionControl {
    /// Emptied in every frame.
    requests: Vec<Request>,
    /// A session whose sockets a thread opens. The thread hands them over, or closes them itself if
    /// they are not wanted any more.
    opening: Option<Mutex<Receiver<Result<Opened, NetError>>>>,
    /// Held while sockets are open that the app has not taken. An attempt that was given up leaves
    /// its port to the next one.
    one_at_a_time: Arc<Mutex<()>>,
    /// Threads that open and close sockets. No frame waits for them.
    threads: Vec<JoinHandle<()>>,
    events: Vec<SessionEvent>,
}

impl SessionControl {
    /// Begins with a session when the app starts.
    pub(crate) fn starting(opened: Option<Opened>) -> Self {
        let mut control = Self::default();
        control.requests.extend(opened.map(Request::Begin));
        control
    }
}

impl Drop for SessionControl {
    /// Waits for the goodbyes of the sessions that were left, at most two seconds.
    fn drop(&mut self) {
        self.opening = None;
        for thread in self.threads.drain(..) {
            // A panic of that thread has been reported there.
            let _ = thread.join();
        }
    }
}

/// Run condition: there is a session, or one begins or ends.
pub(crate) fn is_busy(
    control: Res<SessionControl>,
    state: Res<SessionState>,
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    peer: Option<Res<NetPeer>>,
) -> bool {
    let changes = !control.requests.is_empty() || !control.threads.is_empty() || !control.events.is_empty();
    let there = host.is_some() || guest.is_some() || peer.is_some();
    changes || there || *state != SessionState::Idle
}

/// `PreStartup`: begins the session that the plugin was made with.
pub(crate) fn start(world: &mut World) {
    take_requests(world);
    report(world);
}

/// `PreUpdate`: begins and ends sessions as the app has asked, processes what has arrived, and
/// reports it.
pub(crate) fn follow(world: &mut World) {
    take_requests(world);
    take_opened(world);
    host::receive(world);
    guest::receive(world);
    peer::receive(world);
    report(world);
}

fn take_requests(world: &mut World) {
    let requests = world.get_resource_mut::<SessionControl>().map(|mut control| {
        control.threads.retain(|thread| !thread.is_finished());
        std::mem::take(&mut control.requests)
    });
    for request in requests.unwrap_or_default() {
        leave(world);
        // Without an event nobody looks yet, and what begins now has the next state.
        let over = world.get_resource::<SessionControl>().is_some_and(|control| !control.events.is_empty());
        if over {
            report(world);
        }
        // An observer that leaves a session when it is over means the one that was left here, and
        // not the one that begins now.
        if let Some(mut control) = world.get_resource_mut::<SessionControl>() {
            control.requests.retain(|request| !matches!(request, Request::Leave));
        }
        match request {
            Request::Begin(opened) => begin(world, opened),
            Request::Open(open) => open_apart(world, open),
            Request::Fail(error) => queue_event(world, SessionEvent::failed(error)),
            Request::Leave => {}
        }
    }
}

/// Opens sockets on a thread.
fn open_apart(world: &mut World, open: Open) {
    let Some(mut control) = world.get_resource_mut::<SessionControl>() else { return };
    // Without a buffer, so that sockets that nobody takes are closed on the thread.
    let (hand_over, came) = sync_channel(0);
    let one_at_a_time = Arc::clone(&control.one_at_a_time);
    let run = move || {
        let turn = one_at_a_time.lock().unwrap_or_else(PoisonError::into_inner);
        let unwanted = hand_over.send(open()).err();
        if let Some(SendError(Ok(opened))) = &unwanted {
            opened.end();
        }
        drop(turn);
        drop(unwanted);
    };
    match thread::Builder::new().name("pliant-open".into()).spawn(run) {
        Ok(thread) => {
            control.threads.push(thread);
            control.opening = Some(Mutex::new(came));
        }
        Err(error) => control.events.push(SessionEvent::failed(TransportError::Thread(error).into())),
    }
}

/// Begins the session whose sockets have been opened.
fn take_opened(world: &mut World) {
    let Some(mut control) = world.get_resource_mut::<SessionControl>() else { return };
    let Some(opening) = &mut control.opening else { return };
    let came = match opening.get_mut().unwrap_or_else(PoisonError::into_inner).try_recv() {
        Err(TryRecvError::Empty) => return,
        Err(TryRecvError::Disconnected) => {
            let ended = std::io::Error::other("the thread that opens the socket has ended");
            Err(TransportError::Thread(ended).into())
        }
        Ok(came) => came,
    };
    control.opening = None;
    match came {
        Ok(opened) => begin(world, opened),
        Err(error) => control.events.push(SessionEvent::failed(error)),
    }
}

fn begin(world: &mut World, opened: Opened) {
    match opened {
        Opened::Host(config, carrier) => match NetHost::start(world, carrier, &config) {
            Ok(()) => {
                let joined = SessionJoined { user: UserId::HOST, reconnected: false };
                queue_event(world, SessionEvent::Joined(joined));
            }
            Err(error) => queue_event(world, SessionEvent::failed(error.into())),
        },
        Opened::Guest(guest) => world.insert_resource(*guest),
        Opened::Peer(peer) => world.insert_resource(*peer),
    }
}

/// Leaves whatever session there is.
fn leave(world: &mut World) {
    if let Some(mut control) = world.get_resource_mut::<SessionControl>() {
        control.opening = None;
    }
    if let Some(mut host) = world.remove_resource::<NetHost>() {
        host.end(world);
        close_apart(world, host);
    }
    if let Some(mut guest) = world.remove_resource::<NetGuest>() {
        guest.end(world);
        close_apart(world, guest);
    }
    if let Some(mut peer) = world.remove_resource::<NetPeer>() {
        peer.end(world);
        close_apart(world, peer);
    }
}

/// Closes the sockets and files of a session on a thread, because goodbyes take round trips.
fn close_apart(world: &mut World, session: impl Send + 'static) {
    // Without a thread the session is closed here.
    let thread = thread::Builder::new().name("pliant-close".into()).spawn(move || drop(session));
    if let (Ok(thread), Some(mut control)) = (thread, world.get_resource_mut::<SessionControl>()) {
        control.threads.push(thread);
    }
}

/// Gives a body that a session has displayed back to the app, which steps it on from the shape that
/// was last displayed, and from rest.
pub(crate) fn give_back(world: &mut World, entity: Entity) {
    let Ok(mut entity) = world.get_entity_mut(entity) else { return };
    entity.remove::<(RemoteBody, RemoteHands, FixedObstacles)>();
    entity.insert(Driven::Local);
    let visual = entity.get::<VisualState>().map(|visual| visual.q().to_vec());
    let (Some(visual), Some(mut state)) = (visual, entity.get_mut::<BodyState>()) else { return };
    let set = at_rest(state.body(), visual).and_then(|rest| state.body_mut().set_state(&rest));
    if let Err(error) = set {
        debug!("a body goes on as it was before the session: {error}");
    }
}

/// Returns the state of a body that has had the shape `visual` for long. The session has moved the
/// entity, and the next tick takes the pose over from there. All else that the body has of its own
/// is from before the session.
fn at_rest(body: &Body, visual: Vec<f64>) -> Result<State, StepError> {
    let (before, frame) = (body.state(), body.frame());
    let viscous = !before.z.is_empty();
    let frame = Frame::from_motion(body.model(), frame.center(), frame.orientation(), [0.0; 3], [0.0; 3])?;
    let zero = State::zero(visual.len(), viscous);
    let z = if viscous { visual.clone() } else { Vec::new() };
    Ok(State { q: visual, z, s: vec![0.0; before.s.len()], frame, ..zero })
}

/// Queues an event of the session. It is published when all sessions are back in the world.
pub(crate) fn queue_event(world: &mut World, event: SessionEvent) {
    if let Some(mut control) = world.get_resource_mut::<SessionControl>() {
        control.events.push(event);
    }
}

/// Writes the state of the session, and then its events.
fn report(world: &mut World) {
    let state = state_of(world);
    let changed = world.get_resource_mut::<SessionState>().is_some_and(|mut now| now.set_if_neq(state));
    #[cfg(feature = "states")]
    if let (true, Some(mut next)) = (changed, world.get_resource_mut::<NextState<SessionState>>()) {
        next.set(state);
    }
    if changed {
        debug!("the session is {state:?}");
    }
    publish_events(world);
}

fn publish_events(world: &mut World) {
    let events =
        world.get_resource_mut::<SessionControl>().map(|mut control| std::mem::take(&mut control.events));
    for event in events.unwrap_or_default() {
        match event {
            SessionEvent::Joined(event) => publish(world, event),
            SessionEvent::Lost(event) => publish(world, event),
            SessionEvent::Closed(event) => publish(world, event),
            SessionEvent::BodyArrived(event) => publish(world, event),
            SessionEvent::BodyLeft(event) => publish(world, event),
            SessionEvent::RigidArrived(event) => publish(world, event),
            SessionEvent::RigidLeft(event) => publish(world, event),
            SessionEvent::GrabRefused(event) => publish(world, event),
            SessionEvent::UserJoined(event) => publish(world, event),
            SessionEvent::UserLeft(event) => publish(world, event),
            SessionEvent::Failed(event) => {
                warn!("there is no session: {}", event.reason);
                publish(world, event);
            }
        }
    }
}

fn publish<'a>(world: &mut World, event: impl Message + Clone + Event<Trigger<'a>: Default>) {
    world.write_message(event.clone());
    world.trigger(event);
    world.flush();
}

fn state_of(world: &World) -> SessionState {
    let opening = world.get_resource::<SessionControl>().is_some_and(|control| control.opening.is_some());
    if opening {
        return SessionState::Opening;
    }
    if world.contains_resource::<NetHost>() {
        return SessionState::Hosting;
    }
    if let Some(guest) = world.get_resource::<NetGuest>() {
        return match guest.state() {
            GuestState::Joining => SessionState::Joining,
            GuestState::In { .. } => SessionState::Joined,
            GuestState::Lost { .. } if guest.was_in() => SessionState::Lost,
            GuestState::Lost { .. } => SessionState::Joining,
            GuestState::Closed { .. } => SessionState::Idle,
        };
    }
    match world.get_resource::<NetPeer>().map(NetPeer::state) {
        Some(PeerState::Joining) => SessionState::Joining,
        Some(PeerState::In { .. }) => SessionState::Joined,
        Some(PeerState::Closed { .. }) | None => SessionState::Idle,
    }
}

//! The course of a guest's session: joining, being admitted, losing the host and joining again.

use std::sync::Arc;
use std::time::Duration;

use bevy::prelude::*;
use bevy::tasks::{AsyncComputeTaskPool, block_on, poll_once};
use pliant_body::ModalAsset;
use pliant_modal::ModalModel;
use pliant_stream::{DisconnectReason, GuestEvent, GuestSession, StreamError, UserId};

use super::source::Came;
use super::{GuestState, NetGuest};
use crate::remote::{GrabRefused, SessionJoined, SessionLost};
use crate::retry::Retry;
use crate::session::{SessionEvent, queue_event};
use crate::transport::Fingerprint;
use crate::user::shortened;

/// What a guest remembers of earlier connections to its host.
#[derive(Debug, Default)]
pub(super) struct Rejoin {
    retry: Retry,
    /// Whether the guest has been in the session before.
    pub(super) was_in: bool,
    /// Bodies that have not arrived again by this time are removed.
    orphans_until: Option<Duration>,
}

/// How long after the welcome a body may take to arrive again, before it is removed.
const ORPHANS: Duration = Duration::from_secs(5);

/// Processes the data from the host.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut guest: Mut<NetGuest>| {
        let guest = &mut *guest;
        loop {
            let now = guest.now();
            let Some(came) = guest.source.poll(guest.began, now) else { break };
            match came {
                Came::Connected { role } => {
                    guest.role = role;
                    if let Err(error) = guest.greet(world, now) {
                        error!("the session cannot begin: {error}");
                        guest.close(world, DisconnectReason::InvalidSettings);
                    }
                }
                Came::Datagram { at, bytes } => {
                    if let Some(session) = &mut guest.session {
                        session.on_datagram(at, &bytes);
                    }
                }
                Came::Message { bytes } => {
                    if let Some(session) = &mut guest.session {
                        session.on_message(now, &bytes);
                    }
                }
                Came::Closed { reason } => {
                    // A goodbye of the session arrived earlier and has the more precise reason.
                    guest.take_events(world);
                    guest.ended(world, now, reason);
                }
            }
            guest.take_events(world);
        }
        let now = guest.now();
        guest.take_models();
        guest.take_events(world);
        guest.reconnect(world, now);
        guest.flush();
    });
}

impl NetGuest {
    /// Starts a session on an open connection.
    fn greet(&mut self, world: &World, now: Duration) -> Result<(), StreamError> {
        let most = self.source.max_datagram_size().unwrap_or(0);
        let config = pliant_stream::GuestSessionConfig {
            name: shortened(&self.config.name).to_owned(),
            recovery: self.config.recovery,
            modes: self.config.modes,
            predict_hand: self.config.predict_hand,
            idle_timeout: self.config.transport.limits.idle_timeout,
            models_apart: true,
            ..pliant_stream::GuestSessionConfig::default()
        };
        let mut session = GuestSession::new(config, most)?;
        let loaded = world.get_resource::<Assets<ModalAsset>>();
        let loaded = loaded.into_iter().flat_map(|assets| assets.iter().map(|(_, asset)| &asset.0));
        for model in self.config.models.iter().chain(loaded) {
            session.add_cached_model(Arc::clone(model));
        }
        session.connect(now)?;
        self.end_session();
        self.session = Some(session);
        Ok(())
    }

    /// Decodes a model on the task pool, because a large one takes longer than a frame.
    fn read_model(&mut self, hash: [u8; 32], bytes: Arc<[u8]>) {
        let read = move || ModalModel::from_bytes(&bytes).ok().map(Arc::new);
        match (AsyncComputeTaskPool::try_get(), &mut self.session) {
            (Some(pool), _) => self.being_read.push((hash, pool.spawn(async move { read() }))),
            (None, Some(session)) => session.give_model(hash, read()),
            (None, None) => {}
        }
    }

    /// Hands over the models that have been decoded.
    fn take_models(&mut self) {
        let Some(session) = &mut self.session else { return };
        self.being_read.retain_mut(|(hash, task)| match block_on(poll_once(task)) {
            Some(model) => {
                session.give_model(*hash, model);
                false
            }
            None => true,
        });
    }

    /// Ends the session and keeps its counts.
    fn end_session(&mut self) {
        self.being_read.clear();
        if let Some(session) = self.session.take() {
            self.before.add_counts(&session.stats());
        }
    }

    /// Handles the end of a connection, or a failed attempt.
    fn ended(&mut self, world: &mut World, now: Duration, reason: DisconnectReason) {
        if matches!(self.state, GuestState::Closed { .. }) {
            return;
        }
        let may_come_back = match reason {
            // A host that has left may start again.
            DisconnectReason::Left => true,
            // A guest that was in the session may find a free place later.
            DisconnectReason::Full => self.rejoin.was_in,
            reason => reason.is_loss(),
        };
        if may_come_back && !self.source.is_replay() {
            self.lost(world, now, reason);
        } else {
            self.close(world, reason);
        }
    }

    /// Stops the bodies and schedules the next attempt to join, when the host is lost.
    fn lost(&mut self, world: &mut World, now: Duration, reason: DisconnectReason) {
        self.rejoin.orphans_until = None;
        let key = self.source.fingerprint().unwrap_or(Fingerprint([0; 32]));
        if !self.rejoin.retry.schedule(now, self.config.rejoin, key) {
            return self.close(world, reason);
        }
        self.flush();
        self.end_session();
        if matches!(self.state, GuestState::Lost { .. }) {
            return;
        }
        info!("lost the connection to the host, trying again: {reason}");
        if matches!(self.state, GuestState::In { .. }) {
            self.leave_session(world);
            queue_event(world, SessionEvent::Lost(SessionLost { reason }));
        }
        self.state = GuestState::Lost { reason };
    }

    fn reconnect(&mut self, world: &mut World, now: Duration) {
        if self.rejoin.retry.is_due(now) {
            self.source.rejoin();
        }
        // While the connection is lost, nothing says that the host has removed its bodies.
        let inside = matches!(self.state, GuestState::In { .. });
        if inside && self.rejoin.orphans_until.is_some_and(|until| now >= until) {
            self.rejoin.orphans_until = None;
            self.forget_orphans(world);
            self.forget_orphan_rigids(world);
        }
    }

    /// Ends the grabs and removes the other users.
    fn leave_session(&mut self, world: &mut World) {
        self.grabs.clear();
        self.orphan_bodies(world);
        self.orphan_rigids(world);
        self.users.clear(world);
    }

    fn close(&mut self, world: &mut World, reason: DisconnectReason) {
        if matches!(self.state, GuestState::Closed { .. }) {
            return;
        }
        info!("the session is over: {reason}");
        self.flush();
        self.source.close();
        self.state = GuestState::Closed { reason };
        self.leave_session(world);
        queue_event(world, SessionEvent::over(self.rejoin.was_in, reason));
    }

    /// Leaves the session as the app has asked. The host receives a goodbye, and the bodies are the
    /// app's again, or gone.
    pub(crate) fn end(&mut self, world: &mut World) {
        if let Some(session) = &mut self.session {
            session.leave();
        }
        if self.rejoin.was_in {
            self.close(world, DisconnectReason::Left);
        } else {
            // An attempt that is given up is no failure.
            self.flush();
        }
        self.source.end();
        self.give_back_bodies(world);
        self.orphan_rigids(world);
        self.forget_orphan_rigids(world);
    }

    fn take_events(&mut self, world: &mut World) {
        while let Some(event) = self.session.as_mut().and_then(GuestSession::poll_event) {
            match event {
                GuestEvent::Welcomed { user } => self.welcomed(world, user),
                GuestEvent::ModelCame { hash, bytes } => self.read_model(hash, bytes),
                GuestEvent::BodyReady { body, model } => self.body_ready(world, body, model),
                GuestEvent::BodyChanged { body } => self.body_changed(world, body),
                GuestEvent::BodyPlaced { body, placement } => self.place(world, body, placement),
                GuestEvent::BodyGone { body } => self.body_gone(world, body),
                GuestEvent::RigidArrived { rigid, name } => self.rigid_arrived(world, rigid, name),
                GuestEvent::RigidGone { rigid } => self.rigid_gone(world, rigid),
                GuestEvent::Stalled { body } => {
                    debug!("body {body} stands still: nothing comes from the host")
                }
                GuestEvent::UserJoined(info) => {
                    self.users.join(world, info.user, &info.name, info.role, false);
                }
                GuestEvent::UserLeft { user, reason } => {
                    self.users.leave(world, user, reason);
                }
                GuestEvent::GrabRefused { grab } => {
                    let refused = self.grabs.iter_mut().find(|(_, sent)| sent.own.number == Some(grab));
                    if let Some((&entity, sent)) = refused {
                        sent.own.number = None;
                        queue_event(world, SessionEvent::GrabRefused(GrabRefused { entity }));
                    }
                }
                // Both ends have stopped receiving from each other, so the guest connects again.
                GuestEvent::Closed { reason: DisconnectReason::Silent | DisconnectReason::Lost } => {
                    self.flush();
                    self.source.close();
                    let now = self.now();
                    self.lost(world, now, DisconnectReason::Silent);
                }
                GuestEvent::Closed { reason } => self.close(world, reason),
                _ => {}
            }
        }
    }

    fn welcomed(&mut self, world: &mut World, user: UserId) {
        let reconnected =
            std::mem::replace(&mut self.rejoin, Rejoin { was_in: true, ..Rejoin::default() }).was_in;
        if reconnected {
            self.rejoin.orphans_until = Some(self.now() + ORPHANS);
        }
        self.state = GuestState::In { user };
        let name = shortened(&self.config.name);
        self.users.meet_yourself(world, user, name, self.role);
        info!("in the session as {name}, user {}", user.0);
        let others = self.session.iter().flat_map(|session| session.users());
        for info in others.filter(|info| info.user != user) {
            self.users.meet(world, info.user, &info.name, info.role);
        }
        queue_event(world, SessionEvent::Joined(SessionJoined { user, reconnected }));
    }
}

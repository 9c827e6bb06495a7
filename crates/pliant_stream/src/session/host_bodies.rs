//! The bodies of a session: adding, changing and removing them notifies every guest.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use pliant_modal::{ModalModel, StepSettings};

use super::host::{HostBody, HostSession};
use super::host_config::HostEvent;
use super::host_peer::Transfer;
use crate::state::{BodyId, GrabKey, MAX_MODES, PeerId, Placement};
use crate::wire::HostMessage;
use crate::{StreamError, Surroundings};

impl HostSession {
    /// Adds a body to the session and announces it to the guests at once.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 1,024 bodies, [`StreamError::Config`] for a name over
    /// 64 bytes, a model of more than 4,096 modes or a number in use, and [`StreamError::Model`]
    /// for settings out of their ranges.
    pub fn add_body(
        &mut self,
        body: BodyId,
        name: &str,
        model: Arc<ModalModel>,
        settings: StepSettings,
    ) -> Result<(), StreamError> {
        let bytes = model.to_bytes().into();
        self.add_body_as(body, name, model, bytes, settings)
    }

    /// Adds a body like [`HostSession::add_body`], with the bytes of the model's file
    /// (`model.to_bytes()`) already made, since making them takes long compared with a frame.
    /// Guests leave a session whose models do not match their hashes.
    ///
    /// # Errors
    /// Returns the errors of [`HostSession::add_body`].
    pub fn add_body_as(
        &mut self,
        body: BodyId,
        name: &str,
        model: Arc<ModalModel>,
        bytes: Arc<[u8]>,
        settings: StepSettings,
    ) -> Result<(), StreamError> {
        if self.bodies.len() >= crate::wire::MAX_BODIES {
            return Err(StreamError::Full { what: "bodies", limit: crate::wire::MAX_BODIES });
        }
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        if name.len() > crate::wire::MAX_NAME {
            return fail("body name", name.to_owned(), "at most 64 bytes");
        }
        if self.bodies.contains_key(&body) {
            return fail("body", body.to_string(), "a number that is not in use");
        }
        if model.mode_count() > MAX_MODES {
            return fail("modes", model.mode_count().to_string(), "at most 4096");
        }
        settings.check().map_err(|e| StreamError::Model(e.to_string()))?;
        let entry = HostBody {
            id: body,
            name: name.to_owned(),
            bytes,
            hash: model.hash().0,
            model,
            settings,
            placement: None,
            around: Surroundings::default(),
            last: None,
            resting: false,
            visible: OnceLock::new(),
            streams: BTreeMap::new(),
        };
        self.bodies.insert(body, entry);
        let joined: Vec<PeerId> = self.peers.values().filter(|p| p.user().is_some()).map(|p| p.id).collect();
        for peer in joined {
            self.announce(peer, body);
        }
        Ok(())
    }

    /// Changes the step settings of a body from the next tick on.
    ///
    /// Guests that have the body are notified and receive a snapshot. Hands on the body stay. Do
    /// not call this many times a second, since every change restarts every guest's stream.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body and [`StreamError::Model`] for
    /// settings out of their ranges. The old settings then stay.
    pub fn set_settings(&mut self, body: BodyId, settings: StepSettings) -> Result<(), StreamError> {
        settings.check().map_err(|e| StreamError::Model(e.to_string()))?;
        let entry = self.bodies.get_mut(&body).ok_or(StreamError::UnknownBody(body))?;
        if entry.settings != settings {
            entry.settings = settings;
            self.announce_change(body);
        }
        Ok(())
    }

    /// Tells the guests what stands still around a free body, so that their copies touch it. From
    /// the next tick on the contacts of the body with these obstacles are no load that is sent.
    ///
    /// The obstacles must be those that the host's body touches. Other contacts, as with other
    /// bodies and with what moves, reach the guests as a load. The same holds for anchored bodies,
    /// for guests that take fewer modes than the model has, and for streams of accelerations. As
    /// with [`HostSession::set_settings`], every change restarts the streams of the body.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, and the errors of
    /// [`Surroundings::check`]. The old surroundings then stay.
    pub fn set_surroundings(&mut self, body: BodyId, around: Surroundings) -> Result<(), StreamError> {
        around.check()?;
        let entry = self.bodies.get_mut(&body).ok_or(StreamError::UnknownBody(body))?;
        if entry.around != around {
            entry.around = around;
            self.announce_change(body);
        }
        Ok(())
    }

    /// Tells all guests that have a body what has changed of it, and restarts its streams.
    fn announce_change(&mut self, body: BodyId) {
        let Some(entry) = self.bodies.get_mut(&body) else { return };
        entry.streams.clear();
        let entry = &*entry;
        for p in self.peers.values_mut().filter(|p| p.announced.contains(&body)) {
            let Some(info) = entry.info(p) else { continue };
            p.send_message(&HostMessage::BodyAdded(info), &mut self.out);
            p.due.insert(body);
        }
    }

    /// Places an anchored body in the host's world, and notifies the guests that have the body.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body and [`StreamError::NotFinite`] for
    /// a placement that is not valid ([`Placement::is_valid`]).
    pub fn set_placement(&mut self, body: BodyId, placement: Placement) -> Result<(), StreamError> {
        if !placement.is_valid() {
            return Err(StreamError::NotFinite { what: "placement" });
        }
        let entry = self.bodies.get_mut(&body).ok_or(StreamError::UnknownBody(body))?;
        if entry.placement == Some(placement) {
            return Ok(());
        }
        entry.placement = Some(placement);
        let message = HostMessage::BodyPlaced { body: body.0, placement };
        for p in self.peers.values_mut().filter(|p| p.announced.contains(&body)) {
            p.send_message(&message, &mut self.out);
        }
        Ok(())
    }

    /// Removes a body from the session. Its grabs end.
    pub fn remove_body(&mut self, body: BodyId) {
        if self.bodies.remove(&body).is_none() {
            return;
        }
        let mut ended = Vec::new();
        for peer in self.peers.values_mut() {
            peer.due.remove(&body);
            peer.streaming.remove(&body);
            peer.interest.remove(&body);
            peer.resends.retain(|r| r.1 != body);
            let Some(user) = peer.user() else { continue };
            let gone: Vec<u16> = peer.grabs.iter().filter(|(_, g)| g.body == body).map(|(k, _)| *k).collect();
            for grab in gone {
                peer.grabs.remove(&grab);
                ended.push(HostEvent::GrabEnded { key: GrabKey { user, grab }, body });
            }
            if peer.announced.remove(&body) {
                peer.send_message(&HostMessage::BodyRemoved { body: body.0 }, &mut self.out);
            }
        }
        ended.into_iter().for_each(|e| self.event(e));
    }

    pub(super) fn announce(&mut self, peer: PeerId, body: BodyId) {
        let (Some(p), Some(b)) = (self.peers.get_mut(&peer), self.bodies.get(&body)) else { return };
        let Some(info) = b.info(p) else { return };
        p.send_message(&HostMessage::BodyAdded(info), &mut self.out);
        if let Some(placement) = b.placement {
            p.send_message(&HostMessage::BodyPlaced { body: body.0, placement }, &mut self.out);
        }
        if !p.cached.contains(&b.hash) && !p.transfers.iter().any(|t| t.hash == b.hash) {
            p.transfers.push_back(Transfer { hash: b.hash, bytes: b.bytes.clone(), offset: 0 });
        }
        p.announced.insert(body);
        p.due.insert(body);
    }
}

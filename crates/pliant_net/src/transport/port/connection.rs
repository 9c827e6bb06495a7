//! The connections of a port with another end, and what they send and receive.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use bevy::platform::time::Instant;
use bytes::{Buf, BufMut, Bytes, BytesMut};
use pliant_stream::{Channel, DisconnectReason, PeerId, Role};
use tracing::debug;

use super::{
    Connection, DATAGRAM_HEADER, GOODBYE, MAX_ANSWERS, MESSAGE, OPENS, OPENS_PER_S, Opens, PART, Remote,
    RemotePath,
};
use crate::transport::carrier::Event;
use crate::transport::congestion::Bucket;
use crate::transport::connections::{Connections, GRACE, MESSAGE_PART, PeerConnection};
use crate::transport::queue::{Next, lock};
use crate::transport::stats::PeerStats;

impl Opens {
    pub(super) fn take(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        *self = Self { left: (self.left + passed * OPENS_PER_S).min(OPENS), at: now };
        let is_left = self.left >= 1.0;
        if is_left {
            self.left -= 1.0;
        }
        is_left
    }
}

/// Returns a message of the port.
pub(super) fn message(kind: u8, number: u16, content: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(3 + content.len());
    bytes.put_u8(kind);
    bytes.put_u16_le(number);
    bytes.put_slice(content);
    bytes.freeze()
}

/// Takes the number of a connection from the front.
pub(super) fn take_number(bytes: &mut Bytes) -> Option<u16> {
    bytes.try_get_u16_le().ok()
}

impl Connection {
    pub(super) fn new(
        number: u16,
        id: PeerId,
        hello: Bytes,
        remote: &RemotePath,
        connections: &Arc<Connections>,
    ) -> Self {
        let peer = Arc::<PeerConnection>::default();
        peer.max_datagram.store(remote.max_datagram.saturating_sub(DATAGRAM_HEADER), Ordering::Relaxed);
        let since = Instant::now();
        Self {
            number,
            id,
            since,
            hello: Some(hello),
            admitted: false,
            peer,
            connections: Arc::clone(connections),
            limits: connections.limits.clone(),
            bucket: Bucket::new(connections.limits.rate, since),
            closing: None,
            rest: None,
            parts: BytesMut::new(),
        }
    }

    pub(super) fn admit(&mut self, remote: &Remote, role: Role) {
        self.admitted = true;
        *lock(&self.peer.stats) = remote.measured(PeerStats::default());
        let (peer, fingerprint) = (self.id, remote.path.key);
        let connected = Event::Connected { peer, fingerprint, address: None, role };
        self.connections.open(self.id, Arc::clone(&self.peer), connected);
    }

    pub(super) fn end(self, reason: DisconnectReason) {
        debug!(peer = self.id.0, %reason, "connection closed");
        self.connections.ended(self.id, reason);
    }

    /// Returns what is to be sent next within the cap on the rate, and the reason if that is the
    /// end.
    pub(super) fn next(&mut self, now: Instant) -> Option<(Channel, Bytes, Option<DisconnectReason>)> {
        self.drop_late(now);
        if let Some(hello) = self.hello.take() {
            return Some((Channel::Message, hello, None));
        }
        let outbox = &self.peer.outbox;
        if let Some(len) = outbox.datagram_len().filter(|_| self.admitted)
            && self.bucket.take_datagram(len, now).is_ok()
            && let Some(datagram) = outbox.pop_datagram()
        {
            let mut bytes = BytesMut::with_capacity(DATAGRAM_HEADER + datagram.len());
            bytes.put_u16_le(self.number);
            bytes.put_slice(&datagram);
            return Some((Channel::Datagram, bytes.freeze(), None));
        }
        let len = self.rest.as_ref().map(Bytes::len).or_else(|| outbox.next_len())?;
        self.bucket.take_message(len.min(MESSAGE_PART), now).ok()?;
        let next = match self.rest.take() {
            Some(rest) => Next::Message(rest),
            None => outbox.next()?,
        };
        let (bytes, over) = match next {
            Next::Message(mut rest) if rest.len() > MESSAGE_PART => {
                let part = rest.split_to(MESSAGE_PART);
                self.rest = Some(rest);
                (message(PART, self.number, &part), None)
            }
            Next::Message(last) => (message(MESSAGE, self.number, &last), None),
            Next::Close(reason) => (message(GOODBYE, self.number, &[reason.code()]), Some(reason)),
        };
        Some((Channel::Message, bytes, over))
    }

    /// Drops what a closing connection has not sent in time. Its goodbye is next.
    fn drop_late(&mut self, now: Instant) {
        if self.peer.outbox.is_closing()
            && now.saturating_duration_since(*self.closing.get_or_insert(now)) > GRACE
        {
            self.rest = None;
            self.peer.outbox.drop_messages();
        }
    }

    /// Takes a part of a message. Memory grows with the bytes that have arrived.
    pub(super) fn take_part(&mut self, bytes: Bytes, is_last: bool) {
        if self.parts.len() + bytes.len() > self.limits.message {
            self.parts = BytesMut::new();
            return self.peer.outbox.close(DisconnectReason::Protocol);
        }
        let whole = if self.parts.is_empty() && is_last {
            bytes
        } else {
            self.parts.put_slice(&bytes);
            if !is_last {
                return;
            }
            std::mem::take(&mut self.parts).freeze()
        };
        if self.connections.inbox.push_message(self.id, whole, self.limits.unread_messages()).is_err() {
            // The netcode has delivered it, so that it cannot wait there.
            self.peer.outbox.close(DisconnectReason::Unread);
        }
    }

    fn sent(&self, channel: Channel, bytes: usize) {
        let mut stats = lock(&self.peer.stats);
        stats.sent_packets += 1;
        stats.sent_bytes += bytes as u64;
        stats.sent_datagrams += u64::from(channel == Channel::Datagram);
    }

    pub(super) fn received(&self, channel: Channel, bytes: usize) {
        let mut stats = lock(&self.peer.stats);
        stats.received_packets += 1;
        stats.received_bytes += bytes as u64;
        stats.received_datagrams += u64::from(channel == Channel::Datagram);
    }
}

impl Remote {
    pub(super) fn measured(&self, stats: PeerStats) -> PeerStats {
        let before = if stats.min_round_trip.is_zero() { self.round_trip } else { stats.min_round_trip };
        PeerStats { round_trip: self.round_trip, min_round_trip: before.min(self.round_trip), ..stats }
    }

    /// Returns what is to be sent next to this end.
    pub(super) fn next(&mut self, now: Instant) -> Option<(Channel, Bytes)> {
        if let Some(answer) = self.answers.pop_front() {
            return Some((Channel::Message, answer));
        }
        self.closing.iter_mut().for_each(|closing| closing.drop_late(now));
        // The goodbye of a connection comes before the first message of the next one.
        if let Some(closing) = self.closing.front_mut() {
            // The rest waits for the cap on the rate.
            let (channel, bytes, over) = closing.next(now)?;
            closing.sent(channel, bytes.len());
            if let Some(reason) = over
                && let Some(closed) = self.closing.pop_front()
            {
                closed.end(reason);
            }
            return Some((channel, bytes));
        }
        let open = self.open.as_mut()?;
        let (channel, bytes, over) = open.next(now)?;
        open.sent(channel, bytes.len());
        if let Some(reason) = over
            && let Some(closed) = self.open.take()
        {
            closed.end(reason);
        }
        Some((channel, bytes))
    }

    /// Says goodbye to a connection that this end does not have.
    pub(super) fn refuse(&mut self, number: u16, reason: DisconnectReason) {
        // Who asks so often without reading does not need every answer.
        if self.answers.len() < MAX_ANSWERS {
            self.answers.push_back(message(GOODBYE, number, &[reason.code()]));
        }
    }

    /// Says goodbye to a connection of which a message has come and that this end does not have:
    /// the port is a new one, and its netcode has not notified the other end. Once is enough.
    pub(super) fn deny(&mut self, number: u16) {
        let is_closing = self.closing.iter().chain(&self.open).any(|own| own.number == number);
        if !is_closing && self.denied.replace(number) != Some(number) {
            self.refuse(number, DisconnectReason::Lost);
        }
    }

    /// Returns whether a connection or attempt of a session is open and stays open.
    pub(super) fn has_open(&self, connections: &Arc<Connections>) -> bool {
        let open = self.open.as_ref().filter(|open| !open.peer.outbox.is_closing());
        open.is_some_and(|open| Arc::ptr_eq(&open.connections, connections))
    }

    /// Ends the open connection, if it is one of a session's that are meant.
    pub(super) fn end(&mut self, meant: impl Fn(PeerId) -> bool, of: &Arc<Connections>) {
        let own = |open: &mut Connection| Arc::ptr_eq(&open.connections, of) && meant(open.id);
        // One that has not been announced to the other end is forgotten.
        if let Some(open) = self.open.take_if(own).filter(|open| open.admitted || open.hello.is_none()) {
            open.peer.outbox.close(DisconnectReason::Left);
            self.closing.push_back(open);
        }
    }

    /// Takes the connection with a number.
    pub(super) fn take(&mut self, number: u16) -> Option<Connection> {
        let open = self.open.take_if(|open| open.number == number);
        open.or_else(|| {
            let at = self.closing.iter().position(|closing| closing.number == number)?;
            self.closing.remove(at)
        })
    }

    /// Returns the open connection with a number, once it is admitted and unless it is being
    /// closed.
    pub(super) fn admitted(&mut self, number: u16) -> Option<&mut Connection> {
        let open = |open: &&mut Connection| open.number == number && open.admitted;
        self.open.as_mut().filter(open).filter(|open| !open.peer.outbox.is_closing())
    }
}

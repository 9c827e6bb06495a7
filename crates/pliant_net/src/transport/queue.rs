//! The bounded queues between the application and the network thread.
//!
//! The test `queues` reads this file with loom's locks in the place of `sync`, and runs all orders
//! of the two threads.

use std::collections::{BTreeMap, VecDeque};
use std::sync::PoisonError;

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};

use super::carrier::Event;
use super::sync::{Arc, Mutex, MutexGuard, Notify};

/// Locks a mutex, even if another thread has panicked while it held the lock. The queues hold plain
/// data that is valid between calls.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Everything that waits for the application. The peers are read in turn, one event each, so that
/// neither messages nor datagrams of one peer wait for those of another.
#[derive(Debug, Default)]
pub(super) struct Inbox(Mutex<InboxState>);

#[derive(Debug, Default)]
struct InboxState {
    peers: BTreeMap<PeerId, FromPeer>,
    /// The peers for which something waits, in the order of their turns.
    turns: VecDeque<PeerId>,
    /// The peers for which something waits, but whose share of this frame has been read.
    next_frame: Vec<PeerId>,
    /// What may still be read in this frame.
    left: usize,
    /// The work that the messages of this frame may still make.
    work: usize,
}

#[derive(Debug, Default)]
struct FromPeer {
    /// New connection, messages and closed connection, in order. The peer's share bounds the
    /// messages, and [`Inbox::overloaded`] bounds the rest.
    events: VecDeque<Event>,
    datagrams: VecDeque<(Instant, Bytes)>,
    message_bytes: usize,
    /// What was read in this frame.
    read: usize,
    open: bool,
    room: Arc<Notify>,
}

impl FromPeer {
    fn is_empty(&self) -> bool {
        self.events.is_empty() && self.datagrams.is_empty()
    }
}

/// Most peers with unread events before the host refuses new guests.
const MAX_UNREAD: usize = 4096;
/// Cost of a queued message beside its bytes, bytes. It bounds the number of empty messages.
const MESSAGE_COST: usize = 64;

/// What is read in one frame at most. An event counts one for every 16 bytes, about the length of
/// one target of a hand, and [`EVENT_COST`] besides. 256 guests that move three hands each send
/// half as much in a frame.
pub(super) const READ_IN_A_FRAME: usize = 8192;
/// What is read in one frame of one peer: a full queue of ordinary datagrams.
pub(super) const READ_OF_A_PEER: usize = 512;
const EVENT_COST: usize = 2;
/// What the messages of one frame may make the application do beside reading them, in vertices of
/// new patches. Each costs about a third of a microsecond.
pub(super) const WORK_IN_A_FRAME: usize = 8192;

/// What an event counts of [`READ_IN_A_FRAME`].
fn weight(event: &Event) -> usize {
    let bytes = match event {
        Event::Datagram { bytes, .. } | Event::Message { bytes, .. } => bytes.len(),
        Event::Connected { .. } | Event::Closed { .. } => 0,
    };
    EVENT_COST + bytes / 16
}

impl InboxState {
    /// Changes the queue of a peer, and gives the peer a turn if it had nothing to read before.
    fn push<T>(&mut self, peer: PeerId, change: impl FnOnce(&mut FromPeer) -> T) -> Option<T> {
        let queue = self.peers.get_mut(&peer)?;
        let waited = !queue.is_empty();
        let changed = change(queue);
        if !waited && !queue.is_empty() {
            self.turns.push_back(peer);
        }
        Some(changed)
    }

    fn pop(&mut self, in_frame: bool) -> Option<Event> {
        loop {
            if in_frame && self.left == 0 {
                return None;
            }
            let id = self.turns.pop_front()?;
            let Some(queue) = self.peers.get_mut(&id) else { continue };
            if in_frame && queue.read >= READ_OF_A_PEER {
                self.next_frame.push(id);
                continue;
            }
            let datagrams = &mut queue.datagrams;
            let datagram = |(at, bytes)| Event::Datagram { peer: id, at, bytes };
            // Messages wait for the next frame where those of this one have made enough work, and
            // hands move on.
            let rests = in_frame && self.work == 0;
            let event = (!rests).then(|| queue.events.pop_front()).flatten();
            let event = event.or_else(|| datagrams.pop_front().map(datagram));
            if let Some(Event::Message { bytes, .. }) = &event {
                queue.message_bytes = queue.message_bytes.saturating_sub(bytes.len() + MESSAGE_COST);
                queue.room.notify_one();
            }
            let weight = event.as_ref().map_or(0, weight);
            queue.read += weight;
            self.left = self.left.saturating_sub(weight);
            if rests && queue.datagrams.is_empty() && !queue.events.is_empty() {
                self.next_frame.push(id);
            } else if !queue.is_empty() {
                self.turns.push_back(id);
            } else if !queue.open {
                self.peers.remove(&id);
            }
            if event.is_some() {
                return event;
            }
        }
    }
}

impl Inbox {
    pub(super) fn open(&self, peer: PeerId, connected: Event) -> Arc<Notify> {
        let mut state = lock(&self.0);
        state.peers.entry(peer).or_default();
        let opened = state.push(peer, |queue| {
            queue.open = true;
            queue.events.push_back(connected);
            Arc::clone(&queue.room)
        });
        opened.unwrap_or_default()
    }

    pub(super) fn close(&self, peer: PeerId, reason: DisconnectReason) {
        let mut state = lock(&self.0);
        // A guest's attempt to connect may fail before there is a queue.
        state.peers.entry(peer).or_default();
        state.push(peer, |queue| {
            queue.open = false;
            queue.datagrams.clear();
            queue.events.push_back(Event::Closed { peer, reason });
        });
    }

    /// Drops what waits of a peer, and what it will still send.
    pub(super) fn forget(&self, peer: PeerId) {
        lock(&self.0).peers.remove(&peer);
    }

    pub(super) fn overloaded(&self) -> bool {
        lock(&self.0).peers.len() >= MAX_UNREAD
    }

    /// Queues a datagram. Returns how many datagrams were dropped.
    pub(super) fn push_datagram(&self, peer: PeerId, at: Instant, bytes: Bytes, most: usize) -> u64 {
        let dropped = lock(&self.0).push(peer, |queue| {
            queue.datagrams.push_back((at, bytes));
            let mut dropped = 0;
            while queue.datagrams.len() > most.max(1) {
                queue.datagrams.pop_front();
                dropped += 1;
            }
            dropped
        });
        dropped.unwrap_or(1)
    }

    /// Queues a message, or returns it when the peer's share is full.
    pub(super) fn push_message(&self, peer: PeerId, bytes: Bytes, most: usize) -> Result<(), Bytes> {
        let queued = lock(&self.0).push(peer, |queue| {
            let cost = bytes.len() + MESSAGE_COST;
            if queue.message_bytes > 0 && queue.message_bytes + cost > most {
                return Err(bytes);
            }
            queue.message_bytes += cost;
            queue.events.push_back(Event::Message { peer, bytes });
            Ok(())
        });
        queued.unwrap_or(Ok(()))
    }

    /// Queues a message as [`Inbox::push_message`] does, and waits for `room` where the peer's
    /// share is full.
    pub(super) async fn put_message(&self, peer: PeerId, bytes: Bytes, most: usize, room: &Notify) {
        let mut message = bytes;
        while let Err(back) = self.push_message(peer, message, most) {
            message = back;
            room.notified().await;
        }
    }

    /// Returns the next event of any peer.
    pub(super) fn pop(&self) -> Option<Event> {
        let mut state = lock(&self.0);
        let waiting = std::mem::take(&mut state.next_frame);
        state.turns.extend(waiting);
        state.pop(false)
    }

    /// Begins a frame, in which every peer has its share again.
    pub(super) fn begin_frame(&self) {
        let mut state = lock(&self.0);
        state.left = READ_IN_A_FRAME;
        state.work = WORK_IN_A_FRAME;
        state.peers.values_mut().for_each(|queue| queue.read = 0);
        let mut waiting = std::mem::take(&mut state.next_frame);
        state.turns.extend(waiting.drain(..));
        state.next_frame = waiting;
    }

    /// Counts work that a message of this frame makes.
    pub(super) fn charge(&self, work: usize) {
        let mut state = lock(&self.0);
        state.work = state.work.saturating_sub(work);
    }

    /// Returns the next event within the budget of this frame.
    pub(super) fn pop_in_frame(&self) -> Option<Event> {
        lock(&self.0).pop(true)
    }
}

/// Everything that waits to be sent to one peer.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    state: Mutex<OutboxState>,
    datagram_waits: Notify,
    message_waits: Notify,
    close_waits: Notify,
}

#[derive(Debug, Default)]
struct OutboxState {
    datagrams: VecDeque<Bytes>,
    messages: VecDeque<Bytes>,
    message_bytes: usize,
    /// Reason of the close, until the message writer takes it after the last message.
    closing: Option<DisconnectReason>,
    /// The same reason, which stays set.
    hung_up: Option<DisconnectReason>,
}

/// The next task of the message writer.
#[derive(Debug)]
pub(super) enum Next {
    Message(Bytes),
    Close(DisconnectReason),
}

impl Outbox {
    /// Queues a datagram. Returns how many older datagrams were dropped.
    pub(super) fn push_datagram(&self, bytes: Bytes, most: usize) -> u64 {
        let mut state = lock(&self.state);
        state.datagrams.push_back(bytes);
        let mut dropped = 0;
        while state.datagrams.len() > most.max(1) {
            state.datagrams.pop_front();
            dropped += 1;
        }
        drop(state);
        self.datagram_waits.notify_one();
        dropped
    }

    /// Queues a message. Returns false, and queues nothing, when there is no room or the connection
    /// is closing.
    pub(super) fn push_message(&self, bytes: Bytes, most: usize) -> bool {
        let mut state = lock(&self.state);
        let cost = bytes.len() + MESSAGE_COST;
        if state.hung_up.is_some() || (state.message_bytes > 0 && state.message_bytes + cost > most) {
            return false;
        }
        state.message_bytes += cost;
        state.messages.push_back(bytes);
        drop(state);
        self.message_waits.notify_one();
        true
    }

    /// Returns the bytes of the messages that wait, including [`MESSAGE_COST`] for each.
    pub(super) fn message_bytes(&self) -> usize {
        lock(&self.state).message_bytes
    }

    pub(super) fn close(&self, reason: DisconnectReason) {
        let mut state = lock(&self.state);
        if state.hung_up.is_none() {
            state.hung_up = Some(reason);
            state.closing = Some(reason);
        }
        drop(state);
        self.message_waits.notify_one();
        self.close_waits.notify_one();
    }

    /// Waits for [`Outbox::close`] and returns its reason.
    pub(super) async fn closing(&self) -> DisconnectReason {
        loop {
            if let Some(reason) = lock(&self.state).hung_up {
                return reason;
            }
            self.close_waits.notified().await;
        }
    }

    pub(super) fn pop_datagram(&self) -> Option<Bytes> {
        lock(&self.state).datagrams.pop_front()
    }

    /// Returns the length of the oldest datagram, if one waits.
    pub(super) fn datagram_len(&self) -> Option<usize> {
        lock(&self.state).datagrams.front().map(Bytes::len)
    }

    /// Returns the length of the next message, or 0 for a goodbye, if one of them waits.
    pub(super) fn next_len(&self) -> Option<usize> {
        let state = lock(&self.state);
        state.messages.front().map(Bytes::len).or(state.closing.map(|_| 0))
    }

    /// Drops the messages that wait, so that a goodbye is next.
    pub(super) fn drop_messages(&self) {
        let mut state = lock(&self.state);
        state.messages.clear();
        state.message_bytes = 0;
    }

    /// Returns whether [`Outbox::close`] was called.
    pub(super) fn is_closing(&self) -> bool {
        lock(&self.state).hung_up.is_some()
    }

    /// Waits for a datagram and returns the length of the oldest.
    pub(super) async fn first_datagram_len(&self) -> usize {
        loop {
            if let Some(len) = self.datagram_len() {
                return len;
            }
            self.datagram_waits.notified().await;
        }
    }

    pub(super) fn next(&self) -> Option<Next> {
        let mut state = lock(&self.state);
        if let Some(bytes) = state.messages.pop_front() {
            state.message_bytes = state.message_bytes.saturating_sub(bytes.len() + MESSAGE_COST);
            return Some(Next::Message(bytes));
        }
        state.closing.take().map(Next::Close)
    }

    /// Waits for the next task of the message writer.
    pub(super) async fn wait_next(&self) -> Next {
        loop {
            if let Some(next) = self.next() {
                return next;
            }
            self.message_waits.notified().await;
        }
    }
}

//! Turns a step of the host into frames for all guests.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::DisconnectReason;
use super::host::{HostBody, HostSession, StreamKey, stream_key};
use super::host_peer::GuestPeer;
use crate::StreamError;
use crate::codec::encoder::{Encoded, Encoder};
use crate::codec::quantization::Quanta;
use crate::state::{BodyId, MAX_GRABS, PeerId, TICK_LIMIT, TickState, in_range};
use crate::wire::WIDE_LIMIT;

/// Delays, as shares of a step, after which a tick that begins or ends a grab is sent again. Such a
/// tick cannot be extrapolated, and its repeat arrives only with the next tick.
const EVENT_RESENDS: [f64; 2] = [0.3, 0.65];

/// The output for all receivers of one kind of stream.
struct Outgoing {
    /// The frame; `None` when a snapshot replaces it.
    frame: Option<Encoded>,
    /// All receivers need a snapshot.
    anew: bool,
}

impl HostSession {
    /// Streams one step of a body to all guests.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, [`StreamError::TickOrder`] for a
    /// tick that does not ascend or is out of range, [`StreamError::NotFinite`] for a number that
    /// is not finite or too large, [`StreamError::Length`] for a slice of the wrong length, and
    /// [`StreamError::Full`] for too many grabs. Nothing is sent in these cases.
    pub fn publish(&mut self, now: Duration, body: BodyId, state: &TickState<'_>) -> Result<(), StreamError> {
        let entry = self.bodies.get_mut(&body).ok_or(StreamError::UnknownBody(body))?;
        check_state(entry, state)?;
        let follows = entry.last.is_some_and(|last| last + 1 == state.tick);
        let woke = entry.resting && !state.resting;
        let slept = !entry.resting && state.resting;
        let stays = entry.resting && state.resting;
        entry.last = Some(state.tick);
        entry.resting = state.resting;
        let hash = entry.hash;
        // A snapshot is due for guests that wait for the state and have the model. A guest that is
        // still downloading the model waits, without cost to the others.
        let is_due = |p: &GuestPeer| p.due.contains(&body) && !p.transfers.iter().any(|t| t.hash == hash);
        // Messages are reliable, so the message that the body rests is sent to each guest once.
        if stays && !self.peers.values().any(is_due) {
            return Ok(());
        }
        // After a gap in the ticks, or when the body falls asleep, all guests take the state anew.
        // Waking up continues from the state that all guests have, so only a new run begins.
        let anew = slept || (!follows && !woke && !stays);

        let mut keys: BTreeSet<StreamKey> = BTreeSet::new();
        let mut takers: Vec<(PeerId, StreamKey, bool)> = Vec::new();
        for p in self.peers.values_mut() {
            let Some(key) = stream_key(p, entry) else { continue };
            let due = is_due(p);
            if p.streaming.contains(&body) || due {
                keys.insert(key);
                takers.push((p.id, key, due));
            }
        }
        entry.retire_streams(&keys);
        let mut frames: BTreeMap<StreamKey, Outgoing> = BTreeMap::new();
        for key in keys {
            let encoder = match entry.streams.entry(key) {
                std::collections::btree_map::Entry::Occupied(e) => e.into_mut(),
                std::collections::btree_map::Entry::Vacant(e) => {
                    let visible = entry
                        .visible
                        .get_or_init(|| Quanta::visible_of(&entry.model, entry.model.mode_count()));
                    let made = Encoder::with_visible(
                        body,
                        entry.model.clone(),
                        &entry.settings,
                        self.config.newmark,
                        key.0,
                        key.1,
                        visible,
                    );
                    match made.and_then(|encoder| encoder.among(&entry.around)) {
                        Ok(encoder) => {
                            self.encoders_made += 1;
                            e.insert(encoder.with_quantum(self.config.quantum))
                        }
                        Err(_) => continue,
                    }
                }
            };
            let fresh = encoder.is_fresh() || anew;
            if fresh || stays {
                encoder.restart(state);
                frames.insert(key, Outgoing { frame: None, anew: fresh });
            } else {
                if woke {
                    encoder.begin_run(state.tick - 1);
                }
                self.encoded += 1;
                frames.insert(key, Outgoing { frame: Some(encoder.encode(state)), anew: false });
            }
        }
        for (peer, key, due) in takers {
            let Some(Outgoing { frame, anew: fresh }) = frames.get(&key) else {
                self.drop_peer(peer, DisconnectReason::SmallDatagrams, true);
                continue;
            };
            let Some(p) = self.peers.get_mut(&peer) else { continue };
            if let Some(encoded) = frame
                && p.streaming.contains(&body)
                && !encoded.all().all(|bytes| p.send_frame(bytes, &mut self.out))
            {
                // The path shrank after the key was taken. The next tick uses the new size.
                p.due.insert(body);
            }
            if frame.as_ref().is_some_and(|f| f.events) {
                for share in EVENT_RESENDS {
                    let due = now + Duration::from_secs_f64(share * self.config.newmark.h);
                    p.queue_resend(due, body, state.tick);
                }
            }
            if due || *fresh {
                p.due.remove(&body);
                p.streaming.insert(body);
                self.send_snapshot(peer, body);
            }
        }
        Ok(())
    }
}

fn check_state(body: &HostBody, state: &TickState<'_>) -> Result<(), StreamError> {
    if let Some(last) = body.last
        && state.tick <= last
    {
        return Err(StreamError::TickOrder { last, found: state.tick });
    }
    if state.tick == 0 || state.tick >= TICK_LIMIT {
        return Err(StreamError::TickOrder { last: 0, found: state.tick });
    }
    let modes = body.model.mode_count();
    for (what, slice) in [("q", state.q), ("v", state.v), ("a", state.a)] {
        if slice.is_empty() || slice.len() > modes {
            return Err(StreamError::Length { what, found: slice.len(), expected: modes });
        }
    }
    let viscoelastic = if body.settings.relaxation.is_some() { state.q.len() } else { 0 };
    if state.z.len() != viscoelastic {
        return Err(StreamError::Length { what: "z", found: state.z.len(), expected: viscoelastic });
    }
    if !in_range(state.z) {
        return Err(StreamError::NotFinite { what: "z" });
    }
    if !in_range(state.q) {
        return Err(StreamError::NotFinite { what: "q" });
    }
    if !in_range(state.v) {
        return Err(StreamError::NotFinite { what: "v" });
    }
    if !state.a.iter().all(|x| x.abs() <= WIDE_LIMIT) {
        return Err(StreamError::NotFinite { what: "a" });
    }
    if state.grabs.len() > MAX_GRABS {
        return Err(StreamError::Full { what: "grabs", limit: MAX_GRABS });
    }
    if !state.grabs.iter().all(crate::state::GrabState::is_valid) {
        return Err(StreamError::NotFinite { what: "grab" });
    }
    if state.pose.is_some_and(|p| !p.is_valid()) {
        return Err(StreamError::NotFinite { what: "pose" });
    }
    Ok(())
}

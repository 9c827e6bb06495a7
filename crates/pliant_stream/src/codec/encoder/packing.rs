//! What a frame carries besides the tick: parts, refreshed modes and repeats.

use super::{Encoder, SENT, Sent};
use crate::state::{GrabKey, TickState};
use crate::wire::{FrameGrab, MAX_PARTS, Repeat, RepeatGrab, Slice, SliceEntry, TickFrame};

/// A mode is far off where its error in the mirror is larger than this many quantization steps. Of
/// a body that moves otherwise than receivers compute it (own shapes of held patches, contact),
/// some modes mostly are. Of others hardly any ever is.
const FAR: f64 = 16.0;
/// Largest number of modes in a slice beyond its share, for modes that are far off.
const MORE: usize = 2;

impl Encoder {
    /// Moves the grabs that do not fit out of a frame, into parts of their own.
    pub(super) fn split(&self, frame: &mut TickFrame, room: usize) -> Vec<TickFrame> {
        let mut parts: Vec<TickFrame> = Vec::new();
        if 3 + frame.bytes() <= room {
            return parts;
        }
        let blank = TickFrame { grabs: Vec::new(), pose: None, accelerations: None, ..frame.clone() };
        let mut rest = std::mem::take(&mut frame.grabs).into_iter();
        // 5 bytes: the header of 3 bytes, and the part number and count that are not in any frame
        // yet.
        let fill = |into: &mut TickFrame, rest: &mut std::vec::IntoIter<FrameGrab>| {
            while let Some(g) = rest.as_slice().first()
                && 5 + into.bytes() + into.grab_bytes(g) <= room
            {
                into.grabs.extend(rest.next());
            }
        };
        fill(frame, &mut rest);
        while rest.len() > 0 && parts.len() + 1 < usize::from(MAX_PARTS) {
            let mut part = blank.clone();
            fill(&mut part, &mut rest);
            parts.push(part);
        }
        let of = parts.len() as u8 + 1;
        if of > 1 {
            for (which, part) in std::iter::once(frame).chain(&mut parts).enumerate() {
                part.part = Some((which as u8, of));
            }
        }
        parts
    }

    pub(super) fn keep(&mut self, mut frame: TickFrame, parts: Vec<TickFrame>) {
        frame.repeats.clear();
        frame.grabs.retain(|g| g.held);
        let tick = frame.tick;
        let mut frames = if self.sent.len() >= SENT {
            // This reuses the allocation of the oldest entry.
            self.sent.pop_front().map(|s| s.frames).unwrap_or_default()
        } else {
            Vec::new()
        };
        frames.clear();
        frames.push(frame);
        frames.extend(parts);
        frames.iter_mut().for_each(|f| f.resent = true);
        self.sent.push_back(Sent { tick, frames });
    }

    /// Adds absolute state to the frame and applies it to the mirror. The slice contains the modes
    /// with the largest error in the mirror, and some modes in turn for receivers that missed
    /// frames. It has more modes than its share where several are far off.
    pub(super) fn refresh(&mut self, frame: &mut TickFrame, state: &TickState<'_>, unit: f32, room: usize) {
        if self.subscription.refresh == 0 {
            return;
        }
        let share = self.modes.div_ceil(usize::from(self.subscription.refresh)).min(255);
        let truth = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        // A third of the modes is chosen in turn. The rest have the largest error in the mirror,
        // where a velocity error counts as the displacement that it leads to.
        let turn = share.div_ceil(3);
        let (first, modes) = (self.next_slice, self.modes);
        let in_turn = |k: usize| (k + modes - first) % modes < turn;
        self.chosen.clear();
        self.chosen.extend((0..turn).map(|i| ((first + i) % modes) as u16));
        self.wrong.clear();
        for k in (0..modes).filter(|k| !in_turn(*k)) {
            let eq = (truth(state.q, k) - self.mirror.state.q[k]).abs() / self.quanta.place[k];
            let ev = (truth(state.v, k) - self.mirror.state.v[k]).abs() / self.quanta.speed[k];
            let ez = self
                .mirror
                .state
                .z
                .get(k)
                .map_or(0.0, |z| (truth(state.z, k) - z).abs() / self.quanta.place[k]);
            self.wrong.push((eq + ev + ez, k as u16));
        }
        let far = FAR * f64::from(unit);
        let far = self.wrong.iter().filter(|(error, _)| *error > far).count();
        let most = far.clamp(share - turn, share - turn + MORE).min(self.wrong.len());
        if most > 0 && most < self.wrong.len() {
            self.wrong.select_nth_unstable_by(most - 1, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        }
        self.chosen.extend(self.wrong.iter().take(most).map(|w| w.1));
        let entry = |&mode: &u16| {
            let k = usize::from(mode);
            let load = if self.loaded { self.unexplained[k] } else { 0.0 };
            SliceEntry { mode: k, q: truth(state.q, k), v: truth(state.v, k), load, z: truth(state.z, k) }
        };
        self.entries.clear();
        self.entries.extend(self.chosen.iter().map(entry));
        let viscoelastic = !self.mirror.state.z.is_empty();
        let mut slice = Slice::quantize(&self.entries, unit, self.loaded, viscoelastic, &self.quanta);
        let mut count = slice.steps.len();
        while count > 0 && 3 + frame.bytes() + slice.bytes_of(count) > room {
            // Remove modes first, then repeats.
            if count > share.div_ceil(4) {
                count -= 1;
            } else if frame.repeats.pop().is_some() {
                count = slice.steps.len();
            } else {
                count -= 1;
            }
        }
        if count == 0 {
            return;
        }
        slice.steps.truncate(count);
        self.next_slice = (first + turn.min(count)) % modes;
        for e in slice.entries(&self.quanta) {
            self.mirror.state.q[e.mode] = e.q;
            self.mirror.state.v[e.mode] = e.v;
            self.load[e.mode] = e.load;
            if let Some(z) = self.mirror.state.z.get_mut(e.mode) {
                *z = e.z;
            }
        }
        frame.slice = Some(slice);
    }

    /// Repeats the last ticks in the frame and lists the grabs that ended within them.
    pub(super) fn repeat(&mut self, frame: &mut TickFrame) {
        for sent in self.sent.iter().rev().take(usize::from(self.subscription.repeats)) {
            let Ok(back) = u8::try_from(frame.tick - sent.tick) else { break };
            let mut grabs = Vec::with_capacity(sent.frames.first().map_or(0, |f| f.grabs.len()));
            for g in sent.grabs() {
                let Some(index) = find_or_add(&mut frame.grabs, g) else { continue };
                grabs.push(RepeatGrab { index, reaction: g.state.reaction, displacement: g.displacement });
            }
            let accelerations = sent.frames.first().and_then(|f| f.accelerations.clone());
            frame.repeats.push(Repeat { back, grabs, accelerations });
        }
    }
}

fn find_or_add(grabs: &mut Vec<FrameGrab>, wanted: &FrameGrab) -> Option<u8> {
    let key: GrabKey = wanted.state.key;
    let index = match grabs.iter().position(|g| g.state.key == key) {
        Some(i) => i,
        None if grabs.len() < crate::state::MAX_GRABS => {
            grabs.push(FrameGrab { held: false, ..*wanted });
            grabs.len() - 1
        }
        None => return None,
    };
    u8::try_from(index).ok()
}

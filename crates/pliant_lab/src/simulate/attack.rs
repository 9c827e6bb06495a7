//! What a malicious member sends.

use pliant_stream::Channel;

use super::FaultKind;
use super::schedule::Random;

/// Number of packets that are kept for replays.
const KEPT: usize = 64;

/// A malicious member: what it has sent, to be sent again or altered.
#[derive(Debug, Default)]
pub(super) struct Attacker {
    sent: Vec<(Channel, Vec<u8>)>,
    /// What it does now.
    pub(super) now: Option<FaultKind>,
}

impl Attacker {
    /// Keeps what the member has sent.
    pub(super) fn keep(&mut self, random: &mut Random, channel: Channel, bytes: &[u8]) {
        if self.sent.len() < KEPT {
            self.sent.push((channel, bytes.to_vec()));
        } else {
            let at = random.index(KEPT);
            self.sent[at] = (channel, bytes.to_vec());
        }
    }

    /// What it sends within a look. Messages are few, since one that has no meaning is its last.
    pub(super) fn packets(&self, random: &mut Random) -> Vec<(Channel, Vec<u8>)> {
        let Some(kind) = self.now else { return Vec::new() };
        let count = if kind == FaultKind::Flood { 50 } else { random.range(0, 4) };
        (0..count).filter_map(|_| self.packet(kind, random)).collect()
    }

    fn packet(&self, kind: FaultKind, random: &mut Random) -> Option<(Channel, Vec<u8>)> {
        if kind == FaultKind::Garbage && random.range(0, 3) == 0 {
            let bytes = (0..random.range(0, 300)).map(|_| random.next() as u8).collect();
            return Some((Channel::Datagram, bytes));
        }
        if self.sent.is_empty() {
            return None;
        }
        let (channel, mut bytes) = self.sent[random.index(self.sent.len())].clone();
        if channel == Channel::Message && random.range(0, 40) > 0 {
            return None;
        }
        if kind == FaultKind::Garbage && !bytes.is_empty() {
            for _ in 0..random.range(1, 4) {
                let at = random.index(bytes.len());
                bytes[at] ^= 1 << random.index(8);
            }
        }
        if channel == Channel::Datagram && kind != FaultKind::Replay && bytes.len() >= 3 {
            // Another sequence number: a copy would be dropped at once. A datagram begins with its
            // kind and the number.
            (bytes[1], bytes[2]) = (random.next() as u8, random.next() as u8);
        }
        Some((channel, bytes))
    }
}

//! Hands and numbers of the session, for watchers. Each frame stands alone.

use crate::StreamError;
use crate::state::{BodyId, GrabKey, MAX_GRABS, Tick, UserId};
use crate::wire::{Reader, Writer};

/// Most hands of a frame.
const MAX_HANDS: usize = 16 * MAX_GRABS;
/// A loss that is not known.
const UNKNOWN: u8 = 255;

/// A hand on a body.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WatchHand {
    /// The body.
    pub body: BodyId,
    /// Whose hand it is.
    pub key: GrabKey,
    /// Position of the hand, m, world.
    pub target: [f64; 3],
    /// Force of the body on the hand, N, world.
    pub reaction: [f64; 3],
}

/// Numbers of the session.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WatchNumbers {
    /// Number of people in the session, the host among them.
    pub people: u16,
    /// Mean loss of the guests' links, 0 to 1. `None` while there is none.
    pub loss: Option<f64>,
    /// Mean round trip of the guests' links, s.
    pub round_trip: f64,
    /// Frames for watchers that the host dropped, since they were not fetched in time.
    pub dropped: u32,
}

/// A frame of the track of hands.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WatchHands {
    /// The host's tick.
    pub tick: Tick,
    /// Numbers of the session.
    pub numbers: WatchNumbers,
    /// Hands on the bodies, at most 1,024.
    pub hands: Vec<WatchHand>,
}

impl WatchHands {
    /// The frame in bytes. Positions are rounded to single precision, forces to 2^-16, losses to
    /// 1/254 and round trips to microseconds.
    pub fn encode(&self) -> Vec<u8> {
        let hands = &self.hands[..self.hands.len().min(MAX_HANDS)];
        let mut w = Writer::with_capacity(24 + 27 * hands.len());
        w.tick(self.tick);
        w.u16(self.numbers.people);
        w.u8(self.numbers.loss.map_or(UNKNOWN, |loss| (loss.clamp(0.0, 1.0) * 254.0).round() as u8));
        w.u32((self.numbers.round_trip * 1e6).round() as u32);
        w.u32(self.numbers.dropped);
        w.u16(hands.len() as u16);
        for hand in hands {
            w.u16(hand.body.0);
            w.u16(hand.key.user.0);
            w.u16(hand.key.grab);
            w.vector(hand.target);
            w.vector24(hand.reaction);
        }
        w.into_bytes()
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// An error for wrong bytes, a number that is not finite or more than 1,024 hands.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let mut r = Reader::new(bytes);
        let tick = r.tick("tick of hands")?;
        let people = r.u16("people")?;
        let loss = r.u8("loss")?;
        let numbers = WatchNumbers {
            people,
            loss: (loss != UNKNOWN).then(|| f64::from(loss) / 254.0),
            round_trip: f64::from(r.u32("round trip")?) * 1e-6,
            dropped: r.u32("dropped")?,
        };
        let count = usize::from(r.u16("hands")?);
        if count > MAX_HANDS {
            return Err(StreamError::Full { what: "watched hands", limit: MAX_HANDS });
        }
        let mut hands = Vec::new();
        for _ in 0..count {
            hands.push(WatchHand {
                body: BodyId(r.u16("body of a hand")?),
                key: GrabKey { user: UserId(r.u16("user of a hand")?), grab: r.u16("grab of a hand")? },
                target: r.vector("hand")?,
                reaction: r.vector24("reaction")?,
            });
        }
        r.finish("hands")?;
        Ok(Self { tick, numbers, hands })
    }
}

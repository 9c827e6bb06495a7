//! Datagram between peers: the inputs of the sender's hands, and its impulses.

use pliant_modal::GrabConfig;

use super::datagram::bounded;
use super::hold::{decode_hold, encode_hold, hold_bytes, hold_parts};
use super::{Reader, Writer};
use crate::StreamError;
use crate::state::{BodyId, GrabKey, Tick, UserId};

/// Largest number of ticks in one datagram.
pub(crate) const MAX_TICKS: usize = 16;
/// Largest number of grabs of one user at one tick.
pub(crate) const MAX_HELD: usize = 16;
/// Largest number of impulses of one user at one tick.
pub(crate) const MAX_IMPULSES: usize = 8;
/// Bytes of one impulse.
const IMPULSE_BYTES: usize = 18;
/// Bytes of one grab without spring and damper.
const HELD_BYTES: usize = 25;

/// A grab at one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldAt {
    /// The body.
    pub body: BodyId,
    /// The user's number for the grab.
    pub grab: u16,
    /// Surface vertex at the center of the patch.
    pub vertex: u32,
    /// Radius of the patch, m.
    pub radius: f64,
    /// Position of the hand, world, m.
    pub target: [f64; 3],
    /// The hand's own spring and damper, within what devices have ([`GrabConfig::capped`]).
    pub hold: GrabConfig,
}

impl HeldAt {
    /// Key of the grab among all users.
    pub fn key(&self, user: UserId) -> GrabKey {
        GrabKey { user, grab: self.grab }
    }

    /// Rounds the values as the wire format does.
    pub(crate) fn rounded(mut self) -> Self {
        self.radius = f64::from(self.radius as f32);
        self.target = self.target.map(|x| f64::from(x as f32));
        self.hold = self.hold.capped();
        self
    }

    fn bytes(&self) -> usize {
        HELD_BYTES + hold_bytes(&self.hold)
    }

    fn encode(&self, w: &mut Writer) {
        w.u16(self.body.0);
        w.u16(self.grab);
        w.u32(self.vertex);
        w.f32(self.radius as f32);
        w.vector(self.target);
        w.u8(hold_parts(&self.hold));
        encode_hold(&self.hold, w);
    }

    fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let mut held = Self {
            body: BodyId(r.u16("held body")?),
            grab: r.u16("held grab")?,
            vertex: r.u32("held vertex")?,
            radius: r.f32("held radius")?,
            target: r.vector("held target")?,
            hold: GrabConfig::default(),
        };
        let has = r.u8("held hand")?;
        bounded("held hand", has, 3, "0 to 3")?;
        held.hold = decode_hold(has, r)?;
        if held.radius < 0.0 {
            let found = held.radius.to_string();
            return Err(StreamError::Invalid { what: "held radius", found, expected: "0 m or more" });
        }
        Ok(held)
    }
}

/// An impulse at the beginning of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImpulseAt {
    /// The body.
    pub body: BodyId,
    /// The surface vertex.
    pub vertex: u32,
    /// The impulse, N s, world axes.
    pub impulse: [f64; 3],
}

impl ImpulseAt {
    /// Rounds the values as the wire format does.
    pub(crate) fn rounded(mut self) -> Self {
        self.impulse = self.impulse.map(|x| f64::from(x as f32));
        self
    }

    fn encode(&self, w: &mut Writer) {
        w.u16(self.body.0);
        w.u32(self.vertex);
        w.vector(self.impulse);
    }

    fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let (body, vertex) = (BodyId(r.u16("impulse body")?), r.u32("impulse vertex")?);
        Ok(Self { body, vertex, impulse: r.vector("impulse")? })
    }
}

/// What one user does at one tick.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputTick {
    /// The tick.
    pub tick: Tick,
    /// The grabs, at most 16.
    pub held: Vec<HeldAt>,
    /// The impulses, at most 8, in the order in which they act.
    pub impulses: Vec<ImpulseAt>,
}

impl InputTick {
    fn bytes(&self) -> usize {
        8 + self.held.iter().map(HeldAt::bytes).sum::<usize>() + IMPULSE_BYTES * self.impulses.len()
    }
}

/// Checksum of one body at a tick for which the sender knows all inputs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StateCheck {
    /// The body.
    pub body: BodyId,
    /// The tick.
    pub tick: Tick,
    /// Sum of [`crate::codec::checksum::projection`] over the coordinates, the viscoelastic state
    /// and the rigid frame, as far as the body has them.
    pub value: f32,
}

/// The inputs of a peer's own hands.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Inputs {
    /// The tick that the sender has reached.
    pub now: Tick,
    /// Mean of the sender's tick minus the receiver's tick, at arrival at the sender, ticks; `None`
    /// when unknown.
    pub ahead: Option<f64>,
    /// The inputs, at most 16 ticks.
    pub ticks: Vec<InputTick>,
    /// A checksum, at most one.
    pub check: Option<StateCheck>,
}

impl Inputs {
    /// Number of bytes of a datagram with these ticks.
    pub(crate) fn bytes(ticks: &[InputTick]) -> usize {
        3 + 6 + 2 + 1 + 1 + 12 + ticks.iter().map(InputTick::bytes).sum::<usize>()
    }

    /// Writes the inputs after a datagram header.
    pub(crate) fn encode(&self, w: &mut Writer) {
        w.tick(self.now);
        // The unit is 1/64 tick. A float-to-int cast saturates.
        w.i16(self.ahead.map_or(i16::MIN, |a| ((a * 64.0).round() as i16).max(-i16::MAX)));
        let ticks = &self.ticks[..self.ticks.len().min(MAX_TICKS)];
        w.u8(ticks.len() as u8);
        for t in ticks {
            w.tick(t.tick);
            let held = &t.held[..t.held.len().min(MAX_HELD)];
            w.u8(held.len() as u8);
            held.iter().for_each(|held| held.encode(w));
            let impulses = &t.impulses[..t.impulses.len().min(MAX_IMPULSES)];
            w.u8(impulses.len() as u8);
            impulses.iter().for_each(|impulse| impulse.encode(w));
        }
        w.u8(u8::from(self.check.is_some()));
        if let Some(c) = self.check {
            w.u16(c.body.0);
            w.tick(c.tick);
            w.f32(c.value);
        }
    }

    /// Reads inputs after the datagram header.
    pub(crate) fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let now = r.tick("tick")?;
        let ahead = match r.i16("ahead")? {
            i16::MIN => None,
            steps => Some(f64::from(steps) / 64.0),
        };
        let count = r.u8("tick count")?;
        bounded("tick count", count, MAX_TICKS, "at most 16")?;
        let mut ticks = Vec::with_capacity(usize::from(count));
        for _ in 0..count {
            let tick = r.tick("input tick")?;
            let count = r.u8("held count")?;
            bounded("held count", count, MAX_HELD, "at most 16")?;
            let mut held = Vec::with_capacity(usize::from(count).min(r.left() / HELD_BYTES));
            for _ in 0..count {
                held.push(HeldAt::decode(r)?);
            }
            let count = r.u8("impulse count")?;
            bounded("impulse count", count, MAX_IMPULSES, "at most 8")?;
            let impulses = (0..count).map(|_| ImpulseAt::decode(r)).collect::<Result<_, _>>()?;
            ticks.push(InputTick { tick, held, impulses });
        }
        let flag = r.u8("check flag")?;
        bounded("check flag", flag, 1, "0 or 1")?;
        let check = if flag == 0 {
            None
        } else {
            let (body, tick) = (BodyId(r.u16("check body")?), r.tick("check tick")?);
            Some(StateCheck { body, tick, value: r.wide32("check")? })
        };
        Ok(Self { now, ahead, ticks, check })
    }
}

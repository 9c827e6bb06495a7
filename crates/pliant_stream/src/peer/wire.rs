//! Datagrams and messages between peers; see `docs/protocol.md`.

use serde::{Deserialize, Serialize};

use pliant_modal::GrabConfig;

use crate::StreamError;
use crate::session::{DisconnectReason, MAX_MESSAGE};
use crate::state::{BodyId, GrabKey, MAX_MODES, TICK_LIMIT, Tick, UserId, in_range};
use crate::wire::{Reader, Writer};

const INPUTS: u8 = 6;
const ASK: u8 = 7;
/// Largest number of ticks in one datagram.
pub(crate) const MAX_TICKS: usize = 16;
/// Largest number of grabs of one user at one tick.
pub(crate) const MAX_HELD: usize = 16;
/// Bytes of one grab without spring and damper.
const HELD_BYTES: usize = 25;
/// Bytes of the spring of a grab, and of its damper, if present.
const HOLD_BYTES: usize = 4;

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
}

/// All grabs of one user at one tick.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputTick {
    /// The tick.
    pub tick: Tick,
    /// The grabs, at most 16.
    pub held: Vec<HeldAt>,
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

/// Unreliable datagrams between peers.
#[derive(Debug, Clone, PartialEq)]
pub enum PeerDatagram {
    /// The sender's own inputs.
    Inputs {
        /// The tick that the sender has reached.
        now: Tick,
        /// Mean of the sender's tick minus the receiver's tick, at arrival at the sender, ticks;
        /// `None` when unknown.
        ahead: Option<f64>,
        /// The inputs, at most 16 ticks.
        ticks: Vec<InputTick>,
        /// A checksum, at most one.
        check: Option<StateCheck>,
    },
    /// Requests inputs of the receiver that the sender lacks.
    Ask {
        /// Runs of missing ticks as first tick and count, at most 16.
        runs: Vec<(Tick, u8)>,
    },
}

impl PeerDatagram {
    /// Encodes this datagram.
    pub fn encode(&self, sequence: u16) -> Vec<u8> {
        let mut w = Writer::with_capacity(128);
        match self {
            Self::Inputs { now, ahead, ticks, check } => {
                w.u8(INPUTS);
                w.u16(sequence);
                w.tick(*now);
                // The unit is 1/64 tick. A float-to-int cast saturates.
                w.i16(ahead.map_or(i16::MIN, |a| ((a * 64.0).round() as i16).max(-i16::MAX)));
                let ticks = &ticks[..ticks.len().min(MAX_TICKS)];
                w.u8(ticks.len() as u8);
                for t in ticks {
                    w.tick(t.tick);
                    let held = &t.held[..t.held.len().min(MAX_HELD)];
                    w.u8(held.len() as u8);
                    for g in held {
                        w.u16(g.body.0);
                        w.u16(g.grab);
                        w.u32(g.vertex);
                        w.f32(g.radius as f32);
                        w.vector(g.target);
                        let damper = g.hold.relaxation != 0.0;
                        w.u8(u8::from(g.hold.stiffness.is_some()) | u8::from(damper) << 1);
                        if let Some(stiffness) = g.hold.stiffness {
                            w.f32(stiffness as f32);
                        }
                        if damper {
                            w.f32(g.hold.relaxation as f32);
                        }
                    }
                }
                w.u8(u8::from(check.is_some()));
                if let Some(c) = check {
                    w.u16(c.body.0);
                    w.tick(c.tick);
                    w.f32(c.value);
                }
            }
            Self::Ask { runs } => {
                w.u8(ASK);
                w.u16(sequence);
                let runs = &runs[..runs.len().min(MAX_TICKS)];
                w.u8(runs.len() as u8);
                for (first, count) in runs {
                    w.tick(*first);
                    w.u8(*count);
                }
            }
        }
        w.into_bytes()
    }

    /// Number of bytes of an inputs datagram with these grabs at its ticks.
    pub(crate) fn bytes_of<'a>(ticks: impl Iterator<Item = &'a [HeldAt]>) -> usize {
        let one = |g: &HeldAt| {
            let parts = usize::from(g.hold.stiffness.is_some()) + usize::from(g.hold.relaxation != 0.0);
            HELD_BYTES + parts * HOLD_BYTES
        };
        let tick = |held: &'a [HeldAt]| 7 + held.iter().map(one).sum::<usize>();
        3 + 6 + 2 + 1 + 1 + 12 + ticks.map(tick).sum::<usize>()
    }

    /// Decodes arbitrary bytes into the sequence number and the datagram.
    ///
    /// # Errors
    /// Returns [`StreamError::Truncated`], [`StreamError::Invalid`] or [`StreamError::NotFinite`],
    /// with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<(u16, Self), StreamError> {
        let mut r = Reader::new(bytes);
        let kind = r.u8("datagram kind")?;
        let sequence = r.u16("sequence")?;
        let invalid = |what, found: String, expected| Err(StreamError::Invalid { what, found, expected });
        let datagram = match kind {
            INPUTS => {
                let now = r.tick("tick")?;
                let ahead = match r.i16("ahead")? {
                    i16::MIN => None,
                    steps => Some(f64::from(steps) / 64.0),
                };
                let count = usize::from(r.u8("tick count")?);
                if count > MAX_TICKS {
                    return invalid("tick count", count.to_string(), "at most 16");
                }
                let mut ticks = Vec::with_capacity(count);
                for _ in 0..count {
                    let tick = r.tick("input tick")?;
                    let count = usize::from(r.u8("held count")?);
                    if count > MAX_HELD {
                        return invalid("held count", count.to_string(), "at most 16");
                    }
                    let mut held = Vec::with_capacity(count.min(r.left() / HELD_BYTES));
                    for _ in 0..count {
                        let mut g = HeldAt {
                            body: BodyId(r.u16("held body")?),
                            grab: r.u16("held grab")?,
                            vertex: r.u32("held vertex")?,
                            radius: r.f32("held radius")?,
                            target: r.vector("held target")?,
                            hold: GrabConfig::default(),
                        };
                        let has = r.u8("held hand")?;
                        if has > 3 {
                            return invalid("held hand", has.to_string(), "0 to 3");
                        }
                        if has & 1 != 0 {
                            g.hold.stiffness = Some(r.f32("held stiffness")?);
                        }
                        if has & 2 != 0 {
                            g.hold.relaxation = r.f32("held relaxation")?;
                        }
                        if let Err(error) = g.hold.check() {
                            let expected = "a spring above 0 N/m, a damper of 0 s or more";
                            return invalid("held hand", error.to_string(), expected);
                        }
                        g.hold = g.hold.capped();
                        if g.radius < 0.0 {
                            return invalid("held radius", g.radius.to_string(), "0 m or more");
                        }
                        held.push(g);
                    }
                    ticks.push(InputTick { tick, held });
                }
                let check = match r.u8("check flag")? {
                    0 => None,
                    1 => Some(StateCheck {
                        body: BodyId(r.u16("check body")?),
                        tick: r.tick("check tick")?,
                        value: r.wide32("check")?,
                    }),
                    other => return invalid("check flag", other.to_string(), "0 or 1"),
                };
                Self::Inputs { now, ahead, ticks, check }
            }
            ASK => {
                let count = usize::from(r.u8("ask runs")?);
                if count > MAX_TICKS {
                    return invalid("ask runs", count.to_string(), "at most 16");
                }
                let mut runs = Vec::with_capacity(count);
                for _ in 0..count {
                    runs.push((r.tick("ask tick")?, r.u8("ask count")?));
                }
                Self::Ask { runs }
            }
            other => return invalid("datagram kind", other.to_string(), "6 or 7"),
        };
        r.finish("datagram")?;
        Ok((sequence, datagram))
    }
}

/// The rigid frame of a free body in a [`PeerBodyState`], world axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PeerFrame {
    /// Center of mass, m.
    pub center: [f64; 3],
    /// Body to world, unit quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// Velocity of the center of mass, m/s.
    pub velocity: [f64; 3],
    /// Angular momentum about the center of mass, kg m^2/s.
    pub spin: [f64; 3],
}

/// State of one body in a [`PeerMessage::State`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PeerBodyState {
    /// Number of the body.
    pub body: u16,
    /// Modal coordinates, kg^1/2 m.
    pub q: Vec<f64>,
    /// Velocities.
    pub v: Vec<f64>,
    /// Accelerations.
    pub a: Vec<f64>,
    /// Viscoelastic state of a body that relaxes; empty for an elastic body.
    pub z: Vec<f64>,
    /// Modal forces of the last step, as many as coordinates.
    pub force: Vec<f64>,
    /// The rigid frame of a free body.
    pub frame: Option<PeerFrame>,
    /// The hands on the body in the last step.
    pub pulls: Vec<PeerGrip>,
}

/// Force and target of one hand in the last step of a [`PeerBodyState`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PeerGrip {
    /// User of the hand.
    pub user: u16,
    /// The user's number for the grab.
    pub grab: u16,
    /// Force on the body at the end of the step, N, world axes.
    pub pull: [f64; 3],
    /// Force on the body over the step, N, world axes.
    pub mean: [f64; 3],
    /// Position of the hand, world, m.
    pub target: [f64; 3],
    /// Viscoelastic state of the patch's residual flexibility, m, body axes.
    pub flow: [f64; 3],
}

/// Reliable messages between peers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum PeerMessage {
    /// The first message in each direction.
    Hello {
        /// [`crate::wire::PROTOCOL_VERSION`].
        version: u16,
        /// The sender's number. Every peer has a different one.
        user: u16,
        /// Display name, at most 64 bytes.
        name: String,
        /// The sender has no state yet and wants one.
        joining: bool,
        /// Digest of the sender's bodies and step settings. It must be the same for all peers.
        scene: u64,
    },
    /// Requests the receiver's state, because checks disagree or too many inputs are missing.
    StateRequest,
    /// The state after a tick for which the sender knows all inputs.
    State {
        /// The tick after which the state holds.
        tick: u64,
        /// The tick that the sender has reached.
        now: u64,
        /// All bodies.
        bodies: Vec<PeerBodyState>,
    },
    /// The last message.
    Goodbye {
        /// The reason.
        reason: DisconnectReason,
    },
}

impl PeerMessage {
    /// Encodes this message.
    pub fn encode(&self) -> Vec<u8> {
        // The message is plain data, so serializing it to a growing buffer cannot fail.
        postcard::to_stdvec(self).unwrap_or_default()
    }

    /// Decodes arbitrary bytes and checks every bound.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let invalid = |what, found: String, expected| Err(StreamError::Invalid { what, found, expected });
        if bytes.len() > MAX_MESSAGE {
            return invalid("peer message", format!("{} bytes", bytes.len()), "at most MAX_MESSAGE bytes");
        }
        let message: Self = match postcard::take_from_bytes(bytes) {
            Ok((message, [])) => message,
            Ok((_, rest)) => {
                return invalid("peer message", format!("{} bytes too many", rest.len()), "one message");
            }
            Err(e) => return invalid("peer message", e.to_string(), "a postcard message of this version"),
        };
        match &message {
            Self::Hello { name, .. } if name.len() > crate::wire::MAX_NAME => {
                return invalid("name", name.len().to_string(), "at most 64 bytes");
            }
            Self::State { tick, now, bodies } => {
                if *tick >= TICK_LIMIT || *now >= TICK_LIMIT {
                    return invalid("state tick", tick.to_string(), "below 2^48");
                }
                for b in bodies {
                    let modes = b.q.len();
                    let equal = [&b.v, &b.a, &b.force].iter().all(|x| x.len() == modes) && modes <= MAX_MODES;
                    let frame = b.frame.is_none_or(|f| {
                        in_range(&f.center)
                            && in_range(&f.velocity)
                            && in_range(&f.spin)
                            && (0.5..2.0).contains(&f.orientation.iter().map(|x| x * x).sum::<f64>())
                    });
                    let sane = in_range(&b.q)
                        && in_range(&b.v)
                        && frame
                        && b.a.iter().chain(&b.force).all(|x| x.abs() < 1e15)
                        && in_range(&b.z)
                        && (b.z.is_empty() || b.z.len() == modes)
                        && b.pulls
                            .iter()
                            .all(|p| [&p.pull, &p.mean, &p.target, &p.flow].into_iter().all(|x| in_range(x)));
                    if !(equal && sane) {
                        return invalid("state", "a number or length out of range".into(), "finite numbers");
                    }
                }
            }
            Self::Hello { .. } | Self::StateRequest | Self::Goodbye { .. } => {}
        }
        Ok(message)
    }
}

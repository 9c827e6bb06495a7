//! Settings and events of a host.

use std::time::Duration;

use pliant_modal::GrabConfig;

use super::DisconnectReason;
use crate::newmark::Newmark;
use crate::state::{BodyId, GrabKey, PeerId, UserId};

/// Settings of a host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HostConfig {
    /// The step and the filter by which acceleration streams are read. Default: 1/40 s, and beta 4/9, gamma 5/6
    /// (generalized-alpha with 0.5), which follows any host integrator without ringing. For the paper's own method with a
    /// host that steps by average acceleration: [`Newmark::average`].
    pub newmark: Newmark,
    /// Most guests. Default: 256.
    pub max_guests: usize,
    /// A guest that is silent for so long is gone. Default: 10 s.
    pub idle_timeout: Duration,
    /// Bytes a second at which models are sent to one guest. Default: 1 MB/s.
    pub model_rate: f64,
    /// Bytes a second at which models are sent to all guests together, in turns of 16 KiB: however many fetch at once, each gets its part, and the
    /// frames of the others have the rest of the line. Default: 8 MB/s.
    pub models_rate: f64,
    /// Bits a second of datagrams that one guest may cost. Beyond it, or when a guest's round trip grows by 50 ms over its
    /// least, the guest gets fewer repeats, then fewer refreshes, then fewer modes; no tick is dropped. Default: 1 Mbit/s.
    pub guest_rate: f64,
    /// Answer a NACK only so much later: for remaking the paper's figures. Default: at once.
    pub resend_after: Duration,
    /// What one step of a quantised number may move the surface by, as a share of how far the body is bent, 1e-9 to 0.1 (values outside are brought
    /// there); streams of accelerations take a 64th of it. Default: 2^-14.
    pub quantum: f64,
    /// Let everybody in who says hello; else [`HostEvent::JoinRequest`] asks and
    /// [`crate::HostSession::accept`] answers. Who may come at all is the transport's to know. Default:
    /// true.
    pub open: bool,
}

impl Default for HostConfig {
    fn default() -> Self {
        Self {
            newmark: Newmark { h: 1.0 / 40.0, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 },
            max_guests: 256,
            idle_timeout: Duration::from_secs(10),
            model_rate: 1e6,
            models_rate: 8e6,
            guest_rate: 1e6,
            resend_after: Duration::ZERO,
            quantum: crate::codec::encoder::QUANTUM,
            open: true,
        }
    }
}

/// What happened at the host.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum HostEvent {
    /// Somebody asks to come in; answer with [`crate::HostSession::accept`] or
    /// [`crate::HostSession::refuse`]. Not with `open`.
    JoinRequest {
        /// Who.
        peer: PeerId,
        /// Their name.
        name: String,
    },
    /// A guest is in.
    Joined {
        /// The connection.
        peer: PeerId,
        /// Their number.
        user: UserId,
        /// Their name.
        name: String,
    },
    /// A guest is gone; their grabs have ended ([`HostEvent::GrabEnded`] came before this).
    Left {
        /// The connection.
        peer: PeerId,
        /// Their number, if they had joined.
        user: Option<UserId>,
        /// Why.
        reason: DisconnectReason,
    },
    /// A hand takes hold: the application grabs its body, or says [`crate::HostSession::refuse_grab`].
    GrabBegan {
        /// Whose and which.
        key: GrabKey,
        /// The body.
        body: BodyId,
        /// Center of the patch.
        vertex: u32,
        /// Radius of the patch, m.
        radius: f64,
        /// Where the hand is, world, m.
        target: [f64; 3],
        /// How the hand holds: its own spring and damper, at most 1e5 N/m and 1 s.
        hold: GrabConfig,
    },
    /// A hand moves.
    GrabMoved {
        /// Whose and which.
        key: GrabKey,
        /// The body.
        body: BodyId,
        /// The guest's input counter; ascends.
        input: u32,
        /// Where the hand is, world, m.
        target: [f64; 3],
    },
    /// A hand lets go.
    GrabEnded {
        /// Whose and which.
        key: GrabKey,
        /// The body.
        body: BodyId,
    },
}

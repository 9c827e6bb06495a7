//! Settings and events of a host.

use std::time::Duration;

use pliant_modal::GrabConfig;

use super::DisconnectReason;
use crate::newmark::Newmark;
use crate::state::{BodyId, GrabKey, PeerId, UserId};

/// Settings of a host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HostSessionConfig {
    /// The step, and the filter that reads acceleration streams.
    ///
    /// Default: 1/40 s, and beta 4/9, gamma 5/6 (generalized-alpha with 0.5), which tracks any host
    /// integrator without ringing. For the paper's own method with a host that steps by average
    /// acceleration, use [`Newmark::average`].
    pub newmark: Newmark,
    /// Largest number of guests. Default: 256.
    pub max_guests: usize,
    /// Silence after which a guest counts as gone. Default: 10 s.
    pub idle_timeout: Duration,
    /// Rate at which models are sent to one guest, bytes/s. Default: 1 MB/s.
    pub model_rate: f64,
    /// Rate at which models are sent to all guests together, bytes/s. Guests take turns of 16 KiB,
    /// so that each gets its share however many download at once, and the frames of the others have
    /// the rest of the connection. Default: 8 MB/s.
    pub models_rate: f64,
    /// Largest rate of datagrams to one guest, bit/s.
    ///
    /// Beyond this rate, or when a guest's round trip grows by 50 ms over its minimum, the guest
    /// gets fewer repeats, then fewer refreshes, and of a stream of accelerations then fewer modes.
    /// Rigid bodies take half of the rate at most, and at each level half of that before.
    /// No tick of a body is dropped. Default: 1 Mbit/s.
    pub guest_rate: f64,
    /// Delay of the answers to NACKs, to reproduce the figures of the paper. Default: 0, answers
    /// are sent at once.
    pub resend_after: Duration,
    /// Displacement of the surface by one quantization step, as a share of how far the body is
    /// bent. Values are clamped to 1e-9 to 0.1. Streams of accelerations use a 64th of it. Default:
    /// 2^-14.
    pub quantum: f64,
    /// Accepts every guest that sends a hello. Otherwise [`HostEvent::JoinRequest`] asks, and
    /// [`crate::HostSession::accept`] answers. The transport decides who may connect at all.
    /// Default: true.
    pub open: bool,
}

impl Default for HostSessionConfig {
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

/// An event at the host.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum HostEvent {
    /// A guest asks to join. Answer with [`crate::HostSession::accept`] or
    /// [`crate::HostSession::refuse`]. This event does not occur with [`HostSessionConfig::open`].
    JoinRequest {
        /// The connection.
        peer: PeerId,
        /// Display name of the guest.
        name: String,
    },
    /// A guest joined.
    Joined {
        /// The connection.
        peer: PeerId,
        /// User number of the guest.
        user: UserId,
        /// Display name of the guest.
        name: String,
    },
    /// A guest left. Its grabs have ended ([`HostEvent::GrabEnded`] precedes this event).
    Left {
        /// The connection.
        peer: PeerId,
        /// User number of the guest, if it had joined.
        user: Option<UserId>,
        /// The reason.
        reason: DisconnectReason,
    },
    /// A guest grabs a body. The application grabs the body, or calls
    /// [`crate::HostSession::refuse_grab`].
    GrabBegan {
        /// Identifies the grab.
        key: GrabKey,
        /// The body.
        body: BodyId,
        /// Surface vertex at the center of the patch.
        vertex: u32,
        /// Radius of the patch, m.
        radius: f64,
        /// Position of the hand, world, m.
        target: [f64; 3],
        /// The hand's own spring and damper, at most 1e5 N/m and 1 s.
        hold: GrabConfig,
    },
    /// A hand moved.
    GrabMoved {
        /// Identifies the grab.
        key: GrabKey,
        /// The body.
        body: BodyId,
        /// The guest's input counter, which ascends.
        input: u32,
        /// Position of the hand, world, m.
        target: [f64; 3],
    },
    /// A guest's impulse. The application applies it at the next tick, or drops it.
    Impulse {
        /// The user.
        user: UserId,
        /// The body.
        body: BodyId,
        /// Surface vertex, which exists.
        vertex: u32,
        /// The impulse, N s, world axes. It changes the speed of the whole body by at most
        /// [`MAX_IMPULSE_SPEED`](crate::MAX_IMPULSE_SPEED).
        impulse: [f64; 3],
    },
    /// A grab ended.
    GrabEnded {
        /// Identifies the grab.
        key: GrabKey,
        /// The body.
        body: BodyId,
    },
}

//! Reliable messages between peers.

use pliant_modal::{ContactState, HeldPlace, HeldShapes};
use serde::{Deserialize, Serialize};

use super::message::{check, decode, encode, wide_range};
use super::{MAX_BODIES, MAX_NAME};
use crate::StreamError;
use crate::session::DisconnectReason;
use crate::state::{MAX_MODES, TICK_LIMIT, in_range};

/// Largest number of other peers.
pub(crate) const MAX_PEERS: usize = 64;
/// Longest address at which a peer can be reached, bytes of UTF-8.
pub(crate) const MAX_ADDRESS: usize = 512;

/// Largest number of hands on a body: sixteen of each peer, as many as an input has.
const MAX_HANDS: usize = (MAX_PEERS + 1) * 16;

/// Largest number of sets of shapes of held patches that are remembered of a body.
pub(crate) const MAX_SETS: usize = 16;

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
    pub pulls: Vec<PeerHandState>,
    /// What the contacts of the last step have left for the next.
    pub contacts: ContactState,
    /// Coordinates of the own shapes of held patches; empty where the last step had none.
    pub s: Vec<f64>,
    /// The shapes that count at the tick of the state, and those that count later, at most 16.
    pub shapes: Vec<PeerShapes>,
}

/// The own shapes of held patches that count from a tick on ([`pliant_modal::HeldShapes`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PeerShapes {
    /// The first tick that is stepped with them.
    pub from: u64,
    /// What they are made of, exactly: one to four patches, ascending by vertex and radius.
    pub places: Vec<HeldPlace>,
}

impl PeerShapes {
    fn check(&self) -> Result<(), StreamError> {
        check("tick of shapes", self.from < TICK_LIMIT, self.from, "below 2^48")?;
        check_places(&self.places)
    }
}

fn check_places(places: &[HeldPlace]) -> Result<(), StreamError> {
    let few = (1..=HeldShapes::MAX_PATCHES).contains(&places.len());
    check("held patches", few, places.len(), "1 to 4")?;
    let sane = places.iter().all(|p| p.radius >= 0.0 && in_range(&[p.radius]) && in_range(&p.displacement));
    check("held patches", sane, "a number out of range", "finite numbers")
}

impl PeerBodyState {
    /// The most bytes that this state takes in a message.
    pub(crate) fn most_bytes(&self) -> usize {
        let numbers = [&self.q, &self.v, &self.a, &self.z, &self.force].map(Vec::len);
        // Twelve numbers of a hand and nine of a contact, with what names them.
        // Ten bytes of a tick and at most 37 of each patch.
        let shapes: usize = self.shapes.iter().map(|of| 16 + 40 * of.places.len()).sum();
        256 + 8 * (numbers.iter().sum::<usize>() + self.s.len())
            + 104 * self.pulls.len()
            + 80 * self.contacts.memory.len()
            + shapes
    }

    fn check(&self) -> Result<(), StreamError> {
        let modes = self.q.len();
        let equal = [&self.v, &self.a, &self.force].iter().all(|x| x.len() == modes) && modes <= MAX_MODES;
        let equal = equal && (self.z.is_empty() || self.z.len() == modes);
        check("state lengths", equal, modes, "the same for q, v, a, z and forces, at most 4096")?;
        check("coordinates of shapes", self.s.len() <= MAX_MODES, self.s.len(), "at most 4096")?;
        let sets = &self.shapes;
        check("shapes", sets.len() <= MAX_SETS, sets.len(), "at most 16")?;
        let ascend = sets.windows(2).all(|pair| pair[0].from < pair[1].from);
        check("shapes", ascend, "ticks that do not ascend", "ascending ticks")?;
        sets.iter().try_for_each(PeerShapes::check)?;
        let hands = self.pulls.len();
        check("state hands", hands <= MAX_HANDS, hands, "at most 1040")?;
        let frame = self.frame.is_none_or(|f| {
            let norm = f.orientation.iter().map(|x| x * x).sum::<f64>();
            [f.center, f.velocity, f.spin].iter().all(|x| in_range(x)) && (0.5..2.0).contains(&norm)
        });
        let hand = |p: &PeerHandState| [p.pull, p.mean, p.target, p.viscoelastic].iter().all(|x| in_range(x));
        let sane = frame
            && [&self.q, &self.v, &self.z].iter().all(|x| in_range(x))
            && [&self.a, &self.force, &self.s].iter().all(|x| wide_range(x))
            && self.pulls.iter().all(hand)
            && self.contacts.is_valid();
        check("state", sane, "a number out of range", "finite numbers")
    }
}

/// Force and target of one hand in the last step of a [`PeerBodyState`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PeerHandState {
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
    pub viscoelastic: [f64; 3],
}

/// Reliable messages between peers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum PeerMessage {
    /// The first message in each direction.
    Hello {
        /// [`super::PROTOCOL_VERSION`].
        version: u16,
        /// The sender's number. Every peer has a different one. 0 requests a number.
        user: u16,
        /// Display name, at most 64 bytes.
        name: String,
        /// Where peers that join later reach the sender, at most 512 bytes; empty if nowhere.
        address: String,
        /// The sender has no state yet and wants one.
        joining: bool,
        /// Digest of the sender's bodies and step settings. It must be the same for all peers.
        scene: u64,
    },
    /// The answer to a hello that requests a number.
    Welcome {
        /// The receiver's number.
        user: u16,
        /// The other peers, as numbers and addresses, at most 64.
        others: Vec<(u16, String)>,
    },
    /// Requests the receiver's state, because checks disagree or too many inputs are missing.
    StateRequest,
    /// The state after a tick for which the sender knows all inputs, in as many messages as it
    /// needs.
    State {
        /// The tick after which the state holds.
        tick: u64,
        /// The tick that the sender has reached.
        now: u64,
        /// The next message brings more bodies of this state.
        more: bool,
        /// Bodies, at most 1,024.
        bodies: Vec<PeerBodyState>,
    },
    /// The last message.
    Goodbye {
        /// The reason.
        reason: DisconnectReason,
    },
    /// With whom the sender is connected, for receivers that have lost one of them.
    Others {
        /// The peers, as numbers and addresses, at most 64.
        others: Vec<(u16, String)>,
    },
    /// The own shapes of held patches with which a body is stepped.
    Shapes {
        /// Number of the body.
        body: u16,
        /// The first tick that is stepped with them. 0: they are to be made, and the tick follows.
        from: u64,
        /// What they are made of, exactly: one to four patches, ascending by vertex and radius.
        places: Vec<HeldPlace>,
    },
}

fn check_others(others: &[(u16, String)]) -> Result<(), StreamError> {
    check("other peers", others.len() <= MAX_PEERS, others.len(), "at most 64")?;
    others.iter().try_for_each(|(_, address)| check_address(address))
}

fn check_address(address: &str) -> Result<(), StreamError> {
    check("address", address.len() <= MAX_ADDRESS, address.len(), "at most 512 bytes")
}

impl PeerMessage {
    /// Encodes this message.
    pub fn encode(&self) -> Vec<u8> {
        encode(self)
    }

    /// Decodes arbitrary bytes and checks every bound.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let message: Self = decode("peer message", bytes)?;
        match &message {
            Self::Hello { name, address, .. } => {
                check("name", name.len() <= MAX_NAME, name.len(), "at most 64 bytes")?;
                check_address(address)?;
            }
            Self::Welcome { user, others } => {
                check("user", *user != 0, user, "1 or more")?;
                check_others(others)?;
            }
            Self::Others { others } => check_others(others)?,
            Self::State { tick, now, bodies, .. } => {
                check("state tick", *tick.max(now) < TICK_LIMIT, tick.max(now), "below 2^48")?;
                check("state bodies", bodies.len() <= MAX_BODIES, bodies.len(), "at most 1024")?;
                bodies.iter().try_for_each(PeerBodyState::check)?;
            }
            Self::Shapes { from, places, .. } => {
                check("tick of shapes", *from < TICK_LIMIT, from, "below 2^48")?;
                check_places(places)?;
            }
            Self::StateRequest | Self::Goodbye { .. } => {}
        }
        Ok(message)
    }
}

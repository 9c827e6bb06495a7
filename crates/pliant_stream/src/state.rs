//! Identifiers and plain data of the public interface.

use std::fmt;
use std::time::Duration;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
pub use pliant_modal::State;
use pliant_modal::{Body, Frame, GrabConfig, ModalModel};

use crate::wire::round24;

/// Number of a step of the host. Ticks ascend by one per step of `h` seconds.
pub type Tick = u64;

/// Upper bound of ticks on the wire, exclusive (2^48): 8,900 years at 1 kHz.
pub const TICK_LIMIT: Tick = 1 << 48;

/// Largest number of grabs that are streamed for one body and tick.
pub const MAX_GRABS: usize = 64;

/// Largest number of modes that are streamed for one body.
pub const MAX_MODES: usize = 4096;

/// Largest magnitude of positions and displacements (m), reactions (N) and speeds. Larger values
/// are refused as corrupt.
pub const MAGNITUDE_LIMIT: f64 = 1e9;

/// Largest change of speed that an impulse over a network brings to a whole body, m/s.
pub const MAX_IMPULSE_SPEED: f64 = 100.0;

/// Limits an impulse (N s) of a user to what changes the speed of the whole body by at most
/// [`MAX_IMPULSE_SPEED`]. Hosts and peers apply the same limit, and so do senders.
pub fn capped_impulse(model: &ModalModel, impulse: [f64; 3]) -> [f64; 3] {
    let impulse = Vector3::from(impulse);
    let (most, size) = (model.mass() * MAX_IMPULSE_SPEED, impulse.norm());
    if size > most { (impulse * (most / size)).into() } else { impulse.into() }
}

/// Identifies a connection of the transport. The caller chooses the number, and the session returns
/// it unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct PeerId(pub u64);

impl PeerId {
    /// The host, as a guest addresses it.
    pub const HOST: Self = Self(0);
}

/// Identifies a user in the session. The host numbers its guests from 1; 0 is a user at the host
/// itself.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, serde::Serialize, serde::Deserialize,
)]
pub struct UserId(pub u16);

impl UserId {
    /// The user at the host itself.
    pub const HOST: Self = Self(0);
}

/// What a user may do in a session.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, serde::Serialize, serde::Deserialize,
)]
pub enum Role {
    /// The user may see the bodies and hold them. Default.
    #[default]
    Hold,
    /// The user may only see the bodies, and its grabs are refused. A watcher costs its datagrams
    /// and nothing else.
    Watch,
}

impl Role {
    /// The number of the role on the wire and in recordings.
    pub fn to_byte(self) -> u8 {
        match self {
            Self::Hold => 0,
            Self::Watch => 1,
        }
    }

    /// The role of a number; `None` for a number without one.
    pub fn from_byte(byte: u8) -> Option<Self> {
        [Self::Hold, Self::Watch].into_iter().find(|role| role.to_byte() == byte)
    }
}

/// A user of a session, as the host describes it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct UserInfo {
    /// Number of the user.
    pub user: UserId,
    /// What the user may do.
    pub role: Role,
    /// Display name, at most 64 bytes.
    pub name: String,
}

/// Quality of the host's link to a user.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct UserLinkInfo {
    /// Number of the user.
    pub user: UserId,
    /// Round trip, us.
    pub round_trip: u32,
    /// Loss of the user's datagrams; 255 is total loss.
    pub loss_in: u8,
    /// Loss of the datagrams to the user; 255 is total loss.
    pub loss_out: u8,
}

impl UserLinkInfo {
    /// Rounds a round trip and two shares (0 to 1) to what is sent.
    pub fn new(user: UserId, round_trip: Duration, loss_in: f64, loss_out: f64) -> Self {
        let share = |share: f64| (share.clamp(0.0, 1.0) * 255.0).round() as u8;
        let round_trip = u32::try_from(round_trip.as_micros()).unwrap_or(u32::MAX);
        Self { user, round_trip, loss_in: share(loss_in), loss_out: share(loss_out) }
    }

    /// The round trip.
    pub fn round_trip(&self) -> Duration {
        Duration::from_micros(self.round_trip.into())
    }

    /// The two shares, `loss_in` and `loss_out`, 0 to 1.
    pub fn losses(&self) -> [f64; 2] {
        [self.loss_in, self.loss_out].map(|part| f64::from(part) / 255.0)
    }
}

/// Where the host has placed an anchored body in its world. Frames are in the body's own axes, so
/// only display needs the placement. The frames of a free body contain its pose.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Placement {
    /// Origin of the body's axes, m, world axes.
    pub position: [f32; 3],
    /// Orientation as a unit quaternion (x, y, z, w).
    pub orientation: [f32; 4],
    /// Size of one meter of the model, m.
    pub scale: f32,
}

impl Default for Placement {
    /// The origin, unturned, in the model's size.
    fn default() -> Self {
        Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0], scale: 1.0 }
    }
}

impl Placement {
    /// Whether all numbers are below 1e6, the quaternion has unit length within 1e-3 and the scale
    /// is above 1e-6.
    pub fn is_valid(&self) -> bool {
        let mut numbers = self.position.iter().chain(&self.orientation).chain([&self.scale]);
        let near = numbers.all(|number| number.abs() < 1e6);
        let length = self.orientation.iter().map(|x| x * x).sum::<f32>();
        near && (length - 1.0).abs() < 1e-3 && self.scale > 1e-6
    }
}

/// Identifies a body of the session. The host assigns the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct BodyId(pub u16);

/// Identifies a rigid body of the session. The host assigns the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct RigidId(pub u16);

/// Identifies a grab within the session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct GrabKey {
    /// The user whose hand holds.
    pub user: UserId,
    /// The user's number for the grab. Numbers are not reused within 65,536 grabs.
    pub grab: u16,
}

impl fmt::Display for PeerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl fmt::Display for RigidId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl fmt::Display for BodyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// A rigid body, or the rigid frame of a free body: pose and twist, in world axes.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RigidState {
    /// Origin of the body's frame, m.
    pub position: [f64; 3],
    /// Orientation as a unit quaternion (x, y, z, w).
    pub rotation: [f64; 4],
    /// Velocity of the origin, m/s.
    pub linear: [f64; 3],
    /// Angular velocity, rad/s.
    pub angular: [f64; 3],
}

impl Default for RigidState {
    /// Returns the pose at the origin, unrotated and at rest.
    fn default() -> Self {
        Self { position: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], linear: [0.0; 3], angular: [0.0; 3] }
    }
}

impl RigidState {
    /// Returns the pose of a body: the frame at the model's origin and its twist.
    pub fn of(body: &Body) -> Self {
        Self::of_frame(body.model(), body.frame())
    }

    /// Returns the pose of a frame of `model`.
    pub fn of_frame(model: &ModalModel, frame: &Frame) -> Self {
        let angular = frame.angular_velocity(model);
        let origin = Vector3::from(frame.origin());
        let arm = origin - Vector3::from(frame.center());
        let linear = Vector3::from(frame.velocity()) + angular.cross(&arm);
        Self {
            position: origin.into(),
            rotation: frame.orientation(),
            linear: linear.into(),
            angular: angular.into(),
        }
    }

    /// Returns the frame of a body in this pose, or `None` when a number is not finite.
    pub fn frame(&self, model: &ModalModel) -> Option<Frame> {
        let turn = self.turn()?;
        let arm = turn * Vector3::from(model.center_of_mass());
        let angular = Vector3::from(self.angular);
        let center = Vector3::from(self.position) + arm;
        let velocity = Vector3::from(self.linear) + angular.cross(&arm);
        let inertia = model.inertia();
        let spin = turn * (Matrix3::from_fn(|i, j| inertia[i][j]) * (turn.inverse() * angular));
        Frame::from_motion(model, center.into(), self.rotation, velocity.into(), spin.into()).ok()
    }

    /// The pose as a frame on the wire has it.
    pub(crate) fn rounded(self) -> Self {
        Self {
            position: self.position.map(|x| f64::from(x as f32)),
            rotation: self.rotation.map(|x| f64::from(x as f32)),
            linear: self.linear.map(round24),
            angular: self.angular.map(round24),
        }
    }

    pub(crate) fn turn(&self) -> Option<UnitQuaternion<f64>> {
        let [x, y, z, w] = self.rotation;
        UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
    }

    /// True when every number is finite and within [`MAGNITUDE_LIMIT`] and the quaternion is not
    /// zero.
    pub fn is_valid(&self) -> bool {
        let norm: f64 = self.rotation.iter().map(|x| x * x).sum();
        in_range(&self.position)
            && in_range(&self.linear)
            && in_range(&self.angular)
            && norm.is_finite()
            && norm > 1e-12
    }
}

/// Returns the first free number from `next` on, and sets `next` behind it. Numbers wrap around. If
/// none is free, it is `next`.
pub fn next_free(next: &mut u16, is_free: impl Fn(u16) -> bool) -> u16 {
    let from = *next;
    let found = (0..=u16::MAX).map(|k| from.wrapping_add(k)).find(|&number| is_free(number)).unwrap_or(from);
    *next = found.wrapping_add(1);
    found
}

/// State of a grab at one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GrabState {
    /// Identifies the grab.
    pub key: GrabKey,
    /// Surface vertex at the center of the patch.
    pub vertex: u32,
    /// Radius of the patch on the rest surface, m.
    pub radius: f64,
    /// Position of the hand, world, m.
    pub target: [f64; 3],
    /// Force that the body exerts on the hand, world, N.
    pub reaction: [f64; 3],
    /// The hand's own spring and damper. Over a network they are limited to what devices have
    /// ([`GrabConfig::capped`]). Default: none.
    pub hold: GrabConfig,
}

impl GrabState {
    /// True when every number is finite and within [`MAGNITUDE_LIMIT`], the radius is not negative,
    /// and spring and damper are in their ranges.
    pub fn is_valid(&self) -> bool {
        in_range(&self.target)
            && in_range(&self.reaction)
            && (0.0..=MAGNITUDE_LIMIT).contains(&self.radius)
            && self.hold.check().is_ok()
    }
}

/// State of one body after one step of the host: the input of [`crate::HostSession::publish`].
#[derive(Debug, Clone, Copy)]
pub struct TickState<'a> {
    /// Number of the step. It must exceed the last one published for the body.
    pub tick: Tick,
    /// Modal coordinates, kg^1/2 m, one per mode of the model (or of its first modes).
    pub q: &'a [f64],
    /// Velocities of the modal coordinates.
    pub v: &'a [f64],
    /// Accelerations of the modal coordinates.
    pub a: &'a [f64],
    /// Viscoelastic state of a body that relaxes, kg^1/2 m, as many values as `q`; empty for an
    /// elastic body.
    pub z: &'a [f64],
    /// The rigid frame of a free body; `None` for an anchored one.
    pub pose: Option<RigidState>,
    /// All grabs of the body, at most [`MAX_GRABS`].
    pub grabs: &'a [GrabState],
    /// The body sleeps. The session sends nothing of it until this is false again.
    pub resting: bool,
}

/// True when all values are finite and at most [`MAGNITUDE_LIMIT`] in magnitude.
pub(crate) fn in_range(values: &[f64]) -> bool {
    values.iter().all(|x| x.abs() <= MAGNITUDE_LIMIT)
}

//! Scenes as files: bodies, hands with scripts, a session, a device and a recording, written down in a `.ron` file.
//!
//! ```ron
//! (
//!     title: "a hand on a dragon",
//!     step_hz: 120,
//!     bodies: [
//!         (name: "pip", model: "pip.modal", color: (0.95, 0.5, 0.36)),
//!     ],
//!     grabs: [
//!         (name: "hand", body: "pip", patch: Toward((1, 0.55, 0)), pull: (0.06, 0.02, 0)),
//!     ],
//! )
//! ```
//!
//! Run one with `cargo run --example scene -- assets/scenes/solo.ron`. An app that is there for one scene gives it to [`SceneFilePlugin::open`]; a
//! game that loads scenes as it goes adds [`SceneFilePlugin::default`] and spawns [`SceneInstance`]s. What may be written is in
//! [`SceneDescription`], field by field.
//!
//! A mistake is told with its line and column, and what was expected ([`SceneError`]); one that shows only when the scene runs (a file that is not there, a
//! vertex that the body does not have) as the message [`SceneFailed`]. A file that somebody else wrote may be opened: it is read up to
//! [`MAX_BYTES`], every number is checked, it writes no file but a recording below the working directory, opens no real device, and a host that it makes
//! lets in from other machines only who has the invite. It does open the network connection that it names.
//!
//! A scene does not ask for a camera, a light or a floor; these are the app's.

mod check;
mod describe;
#[cfg(feature = "haptics")]
mod device;
mod error;
mod file;
mod hands;
mod locate;
mod motion;
mod needs;
#[cfg(feature = "net")]
mod network;
mod plugin;
#[cfg(feature = "rerun")]
mod recording;
mod spawn;
mod syntax;

pub use describe::{
    BakeEntry, BodyEntry, By, ColorEntry, CopiesEntry, DeviceEntry, GrabEntry, Grip, GuestEntry, Like,
    Motion, NetworkEntry, PatchEntry, PointEntry, RecordingEntry, SceneDescription, TouchEntry,
    TransformEntry, ViewEntry,
};
pub use error::{SceneError, SceneErrorKind};
pub use file::{SceneFile, SceneFileLoader};
pub use plugin::SceneFilePlugin;
pub use spawn::{PartOf, SceneBody, SceneClock, SceneFailed, SceneInstance, SceneParts};

/// Longest scene file that is read, bytes.
pub const MAX_BYTES: usize = 1 << 20;

/// Most bodies of a scene, copies counted.
pub const MAX_BODIES: usize = 4096;

/// Most grabs of a scene.
pub const MAX_GRABS: usize = 1024;

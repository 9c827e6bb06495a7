//! Scenes as files: bodies, scripted hands, a session, a device and a recording in a `.ron` file.
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
//! Run a scene file with `cargo run --example scene -- assets/scenes/solo.ron`. An app that plays
//! one scene passes it to [`SceneFilePlugin::open`]. A game that loads scenes while it runs adds
//! [`SceneFilePlugin::default`] and spawns [`SceneInstance`]s. [`SceneDescription`] documents every
//! field of the file.
//!
//! A mistake is reported with its line, its column and what was expected ([`SceneError`]). A
//! mistake that shows only while the scene runs, such as a missing file or a vertex that the body
//! does not have, is sent as the message [`SceneFailed`].
//!
//! Opening a scene file from an untrusted source is bounded: at most [`MAX_BYTES`] are read, and
//! every number is checked. The scene writes no file except a recording below the working
//! directory, and it opens no real device. A host that the scene creates accepts guests from other
//! machines only with the invite. The scene does open the network connection that it names.
//!
//! A scene does not describe a camera, a light or a floor; the app provides these.

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

/// Maximum length of a scene file, bytes.
pub const MAX_BYTES: usize = 1 << 20;

/// Maximum number of bodies in a scene, copies included.
pub const MAX_BODIES: usize = 4096;

/// Maximum number of grabs in a scene.
pub const MAX_GRABS: usize = 1024;

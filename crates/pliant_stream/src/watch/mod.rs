//! What watchers without number get over relays: a catalog, models, bodies and hands.
//!
//! A host can publish its session over Media over QUIC, whose relays cache and fan out without
//! knowing what they carry. A *broadcast* has *tracks*, a track has *groups*, and a group has
//! *frames*. A late watcher begins with the newest group, so each group begins with all that it
//! needs:
//!
//! | track | a group | made and read by |
//! | --- | --- | --- |
//! | [`CATALOG_TRACK`] | one frame: the whole catalog | [`Catalog`] |
//! | [`model_track`] | the pieces of a `.modal` file | [`pieces`], [`Assembler`] |
//! | [`surface_track`] | the pieces of the surface and the modes, for shaders | [`WatchSurface`] |
//! | [`body_track`] | a snapshot, then frames that lean on it | [`BodyEncoder`], [`BodyDecoder`] |
//! | [`HANDS_TRACK`] | frames that stand alone: hands and numbers of the session | [`WatchHands`] |
//!
//! Guests get another stream ([`codec`](crate::codec)), which predicts with the kernel that steps
//! the body. Watchers have no kernel: a page in a browser draws, and nothing else. So the frames
//! here carry the visible state only: coordinates in steps of equal displacement on the surface,
//! predicted from the coordinates before them in whole numbers, which gives the same result on
//! every machine and in every language. The rounding error never adds up.
//!
//! Nothing that a watcher receives is to be trusted, since anyone may run a relay. Every parser
//! here takes any bytes, checks lengths, ranges and finiteness, and allocates in proportion to the
//! bytes given.

mod body;
mod catalog;
mod hands;
mod pieces;
mod playout;
mod residual;
mod surface;

pub use body::{BodyDecoder, BodyEncoder, EncodedFrame, WatchConfig, WatchFrame, WatchedState};
pub use catalog::{Catalog, CatalogBody, CatalogCamera};
pub use hands::{WatchHand, WatchHands, WatchNumbers};
pub use pieces::{Assembler, MAX_PIECE, pieces};
pub use playout::{BodyPlayout, HandsPlayout, TickClock};
pub use surface::{WatchSurface, coordinate_steps};

use crate::BodyId;
use pliant_modal::ModelHash;

/// Version of the formats in this module. A catalog says it, and a watcher of another version does
/// not watch.
pub const WATCH_VERSION: u16 = 1;

/// Name of the track with the catalog.
pub const CATALOG_TRACK: &str = "catalog";

/// Name of the track with hands and numbers.
pub const HANDS_TRACK: &str = "hands";

/// Largest frame of any track that a watcher reads, bytes.
pub const MAX_FRAME: usize = 1 << 18;

/// Most frames that a watcher reads of one group of a body. A publisher begins a new group long
/// before: a group that does not end is not kept in memory anywhere.
pub const MAX_GROUP_FRAMES: usize = 1 << 10;

/// Largest model or surface that is published and assembled, bytes.
pub const MAX_MODEL: usize = 30 << 20;

/// Name of the track of a body.
pub fn body_track(body: BodyId) -> String {
    format!("body/{body}")
}

/// Name of the track with the `.modal` file of a model.
pub fn model_track(model: ModelHash) -> String {
    format!("model/{model}")
}

/// Name of the track with the surface of a model, flattened for shaders.
pub fn surface_track(model: ModelHash) -> String {
    format!("surface/{model}")
}

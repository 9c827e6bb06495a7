//! Sessions for watchers without number, over relays of Media over QUIC (feature `watch`).
//!
//! A host publishes its session to a relay ([`NetHost::publish_to_watchers`]). Relays cache it and
//! pass it on, to other relays and to whoever watches: apps with
//! [`WatchCommands::watch_session`], or anything else that reads the formats. The host pays for one
//! stream, whatever the number of watchers. Nothing that a watcher sends reaches the host.
//!
//! What crosses is [`pliant_stream::watch`]; the page `docs/watching.md` has it byte by byte.
//!
//! [`NetHost::publish_to_watchers`]: crate::NetHost::publish_to_watchers

mod follow;
mod plugin;
mod publish;
mod relay;

pub use follow::{WatchEvent, Watcher};
pub use pliant_stream::watch::{CatalogCamera, WatchConfig, WatchHand, WatchNumbers};
pub use plugin::{WatchCommands, WatchPlugin, WatchState};
pub use publish::{PublishOptions, PublishStats, WatchView};
pub use relay::{RelayOptions, RelayTrust, WatchError};

pub(crate) use publish::{HostWatch, Seen};

//! Tests of sessions that ride on an app's own carrier.

mod network;
mod port;
mod sessions;

use crate::support;

//! Tests of endpoints on loopback: what arrives, what is refused, and who notices that a peer is
//! gone.

mod crossing;
mod endpoints;
mod entering;
mod misbehaving;
mod unauthenticated;

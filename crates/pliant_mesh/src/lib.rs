//! Surfaces, signed distance fields and tetrahedra for Pliant: import, export, isosurface stuffing.
//!
//! Lengths are in metres, coordinates are `f64`, indices are `u32` and count from 0.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod bvh;
mod error;
pub mod io;
mod repair;
pub mod sdf;
pub mod shapes;
mod solid;
pub mod stuffing;
mod surface;
mod tets;

pub use error::{MeshError, Place};
pub use repair::Repair;
pub use stuffing::{Parts, StuffOptions, stuff};
pub use surface::Surface;
pub use tets::{Quality, TetMesh};

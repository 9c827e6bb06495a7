//! Surfaces, signed distance fields and tetrahedra for Pliant: import, export and isosurface
//! stuffing.
//!
//! ```
//! use pliant_mesh::{StuffOptions, io, sdf::SurfaceDistance, shapes, stuff};
//!
//! // Any closed surface will do: io::read_surface("bunny.obj")?; SurfaceDistance::mended takes dirty ones too.
//! let (surface, _) = shapes::sphere(8, 0.1)?.boundary();
//! let shape = SurfaceDistance::new(&surface)?;
//! let mesh = stuff(&shape, &StuffOptions::with_target(5000), &mut |_share| ())?;
//! assert!(mesh.tets.len().abs_diff(5000) <= 250);
//! // Corners are rounded by up to a cell, so a little is missing.
//! assert!((0.97..1.0).contains(&(mesh.volume() / surface.volume())));
//! let file = std::env::temp_dir().join(format!("ball-{}.msh", std::process::id()));
//! io::write_msh(&file, &mesh)?;
//! # std::fs::remove_file(file).ok();
//! # Ok::<(), pliant_mesh::MeshError>(())
//! ```
//!
//! Lengths are in meters, coordinates are `f64`, and indices are `u32` and start at 0.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod bvh;
mod error;
pub mod io;
mod locator;
mod repair;
pub mod sdf;
pub mod shapes;
mod solid;
pub mod stuffing;
mod surface;
mod tets;

pub use error::{MeshError, Place};
pub use locator::{ClosestPoint, SurfaceLocator};
pub use repair::Repair;
pub use stuffing::{Parts, StuffOptions, stuff};
pub use surface::Surface;
pub use tets::{Quality, TetMesh};

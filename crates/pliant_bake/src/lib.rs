//! Turns a tetrahedral mesh into a modal model.
//!
//! [`bake()`] takes tetrahedra and a material and computes the lowest elastic modes of
//! `K phi = omega^2 M phi` in four steps:
//!
//! 1. The finite-element step assembles linear elasticity on 4-node or 10-node tetrahedra with the
//!    consistent mass matrix. All integrals are exact. Near incompressibility (Poisson ratio above
//!    0.45) the pressure is averaged over nodes to avoid locking.
//! 2. Nested dissection by coordinate bisection orders the matrix, and a multifrontal Cholesky
//!    factorization factors it. faer does the dense work.
//! 3. Shift-invert block Lanczos with the M-inner product, full reorthogonalization and thick
//!    restart computes the modes. The six rigid modes of a body without anchors are removed
//!    analytically. A Sturm count verifies that no mode is missing.
//! 4. The surface step computes the mode shapes and their rotations at the vertices, the
//!    participation of gravity, the mass properties, the damping, and the *residual flexibility* of
//!    patches, which is the part of the compliance under a hand that the kept modes leave out.
//!
//! Every bake checks its residuals and its orthonormality and stores both. The result is the same
//! to the bit for any number of threads.
//!
//! ```
//! use pliant_bake::{BakeConfig, bake};
//!
//! let mesh = pliant_mesh::shapes::bar([10, 2, 2], [1.0, 0.2, 0.2])?;
//! let config = BakeConfig { modes: 6, anchors: vec!["x<0.001".parse()?], ..BakeConfig::linear() };
//! let baked = bake(&mesh, None, &config, &mut |_, _| ())?;
//! assert_eq!(baked.model.mode_count(), 6);
//! assert!(baked.model.info().residual_max < 1e-8);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod anchor;
mod bake;
mod blocks;
mod cache;
mod canonical;
mod compliance;
mod config;
mod continuum;
mod cubature;
mod derivatives;
mod element;
mod embedding;
mod error;
mod factor;
mod fem;
mod flexibility;
mod lanczos;
mod matrix_market;
mod nonlinear;
mod ordering;
mod region;
mod rigid;
mod solver;
mod sparse;
mod sturm;
mod support;
mod surface;
mod symbolic;

#[cfg(test)]
mod physics_tests;

pub use anchor::{Anchor, AnchorSyntax, Comparison};
pub use bake::bake;
pub use cache::{BakeCache, BakeKey, CachedBake, METHOD_VERSION, bake_cached};
pub use config::{Bake, BakeConfig, BakeTimes, MaterialSyntax, Stage};
pub use error::BakeError;
pub use nonlinear::{DeadLoad, Deflection, PrescribedPatch, StaticLoads, deflect};
pub use pliant_modal::Material;
pub use region::{Paint, Region, RegionSyntax};

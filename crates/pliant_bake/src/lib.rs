//! From a mesh to a modal model: finite elements, sparse factorisation and vibration modes.
//!
//! [`bake()`] takes tetrahedra and a material and finds the lowest elastic modes of `K phi = omega^2 M phi`:
//!
//! 1. linear elasticity on 4-node or 10-node tetrahedra, consistent mass, all integrals exact; near
//!    incompressibility (Poisson ratio above 0.45) the pressure is averaged over nodes, so that nothing locks;
//! 2. nested dissection by coordinate bisection and a multifrontal Cholesky factorisation (dense work by faer);
//! 3. shift-invert block Lanczos with the M-inner product, full reorthogonalisation and thick restart; a body without
//!    anchors keeps its six rigid modes out analytically; a Sturm count makes sure that none is missed;
//! 4. what a body needs at its surface: mode shapes and their rotations at the vertices, gravity's participation, mass
//!    properties, damping, and the *residual flexibility* of patches: what the kept modes leave out of the
//!    compliance that a hand feels.
//!
//! Every bake checks its residuals and orthonormality, stores them, and gives the same bits for any number of threads.
//!
//! ```
//! use pliant_bake::{BakeConfig, bake};
//!
//! let mesh = pliant_mesh::shapes::bar([10, 2, 2], [1.0, 0.2, 0.2])?;
//! let config = BakeConfig { modes: 6, anchors: vec!["x<0.001".parse()?], ..BakeConfig::default() };
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
pub use config::{Bake, BakeConfig, BakeTimes, Stage};
pub use error::BakeError;
pub use nonlinear::{DeadLoad, Deflection, deflect};

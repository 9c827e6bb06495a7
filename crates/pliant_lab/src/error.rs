//! Errors of the laboratory.

use std::path::PathBuf;

/// The reason why a measurement stops.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// A mesh cannot be read or generated.
    #[error("{0}")]
    Mesh(#[from] pliant_mesh::MeshError),
    /// A mesh cannot be baked.
    #[error("{0}")]
    Bake(#[from] pliant_bake::BakeError),
    /// A model or one of its patches was rejected.
    #[error("{0}")]
    Model(#[from] pliant_modal::ModelError),
    /// A body cannot be stepped.
    #[error("{0}")]
    Step(#[from] pliant_modal::StepError),
    /// A session or a link was rejected.
    #[error("{0}")]
    Stream(#[from] pliant_stream::StreamError),
    /// The device loop does not start.
    #[error("{0}")]
    Device(#[from] pliant_haptics::StartError),
    /// A virtual device was rejected.
    #[error("{0}")]
    DeviceInfo(#[from] pliant_haptics::InfoError),
    /// A number of tetrahedra was requested for a file that already holds tetrahedra.
    #[error("{0} holds tetrahedra already; expected a surface or a scene")]
    TetsGiven(PathBuf),
    /// This number of threads cannot be started.
    #[error("threads: expected 1 to {most}, got {got}")]
    Threads {
        /// The requested number of threads. 0 means one per core.
        got: usize,
        /// The largest allowed number of threads.
        most: usize,
    },
    /// A hand cannot pull a body that has no anchors, because the body follows.
    #[error("the body is free and follows the hand; expected a body with anchors")]
    Free,
    /// A body with anchors cannot fall.
    #[error("the body has anchors and cannot fall; expected a free body")]
    Anchored,
    /// Reduced elasticity was asked for, and the model has none.
    #[error("the model has no material for large strains; expected one baked with --material")]
    NoMaterial,
    /// A point where a hand should take hold is far away from the body.
    #[error("the point is {away} m away from the surface of a body of {size} m; expected one near it")]
    Far {
        /// Distance from the surface, m.
        away: f64,
        /// Size of the body, m.
        size: f64,
    },
    /// A plot cannot be drawn into this file.
    #[error("{0}: cannot be drawn")]
    Plot(PathBuf),
    /// A file of the report cannot be written.
    #[error("cannot write: {0}")]
    Write(#[from] std::io::Error),
}

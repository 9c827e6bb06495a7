//! What can go wrong in the laboratory.

use std::path::PathBuf;

/// Why a measurement stops.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// A mesh cannot be read or made.
    #[error("{0}")]
    Mesh(#[from] pliant_mesh::MeshError),
    /// A mesh cannot be baked.
    #[error("{0}")]
    Bake(#[from] pliant_bake::BakeError),
    /// A model or one of its patches is refused.
    #[error("{0}")]
    Model(#[from] pliant_modal::ModelError),
    /// A body cannot be stepped.
    #[error("{0}")]
    Step(#[from] pliant_modal::StepError),
    /// A session or a link is refused.
    #[error("{0}")]
    Stream(#[from] pliant_stream::StreamError),
    /// The device loop does not start.
    #[error("{0}")]
    Device(#[from] pliant_haptics::StartError),
    /// A virtual device is refused.
    #[error("{0}")]
    DeviceInfo(#[from] pliant_haptics::InfoError),
    /// A file holds tetrahedra where a shape was to be filled with a number of them.
    #[error("{0} holds tetrahedra already; expected a surface or a scene")]
    TetsGiven(PathBuf),
    /// So many threads cannot be started.
    #[error("threads: expected 1 to {most}, got {got}")]
    Threads {
        /// How many were asked for; 0: one a core.
        got: usize,
        /// The most there may be.
        most: usize,
    },
    /// A figure cannot be drawn into this file.
    #[error("{0}: cannot be drawn")]
    Plot(PathBuf),
    /// A file of the report cannot be written.
    #[error("cannot write: {0}")]
    Write(#[from] std::io::Error),
}

//! What is asked for, how far it is, and why it did not work.

use std::{fmt, path::PathBuf, sync::Arc};

use bevy::prelude::*;
use pliant_bake::{BakeConfig, BakeError};
use pliant_mesh::{MeshError, Repair, Surface, TetMesh, io::Input, sdf::SignedDistance};
use thiserror::Error;

/// Asks for the body of this entity to be baked. Needs [`BakePlugin`](crate::BakePlugin).
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_bake::BakeConfig;
/// # use pliant_body::{BakeRequest, ModalBody};
/// fn setup(mut commands: Commands) {
///     let config = BakeConfig { modes: 30, young: 4e4, ..default() };
///     commands.spawn((BakeRequest { tets: 8_000, config, ..BakeRequest::file("models/pip.ron") }, ModalBody::default()));
/// }
/// ```
///
/// The [`ModalBody`](crate::ModalBody) beside it may have any settings, its model is written when there is one; without a `ModalBody`
/// one is added. A new model replaces an old one as any swap of the handle does: the body begins at rest, grabs stay.
#[derive(Component, Reflect, Debug, Clone)]
#[reflect(opaque)]
#[reflect(Component, Debug, Clone, from_reflect = false)]
#[require(BakeProgress)]
pub struct BakeRequest {
    /// What is filled with tetrahedra.
    pub shape: BakeShape,
    /// About how many tetrahedra, where the shape has none of its own. Default: 10,000.
    pub tets: usize,
    /// What is seen. Default: [`BakeSkin::Tetrahedra`].
    pub skin: BakeSkin,
    /// The material, the number of modes, what is held fixed. Default: [`BakeConfig::default`], a free body of soft silicone.
    pub config: BakeConfig,
}

impl BakeRequest {
    /// A bake of `shape` with everything else at its default.
    pub fn new(shape: BakeShape) -> Self {
        Self { shape, tets: 10_000, skin: BakeSkin::default(), config: BakeConfig::default() }
    }

    /// A bake of a file; see [`BakeShape::File`].
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Self::new(BakeShape::File(path.into()))
    }
}

/// What a body is made of before it is baked.
#[derive(Clone)]
pub enum BakeShape {
    /// A file on disk: a surface, mended if it is dirty (`.obj`, `.stl`, `.ply`, `.gltf`, `.glb`), a scene of rounded parts (`.ron`) or tetrahedra (`.msh`,
    /// `.vtk`, `.mesh`, `.veg`). A relative path begins in the working directory, not in the folder of assets.
    File(PathBuf),
    /// A surface, a scene or tetrahedra that are there already.
    Input(Arc<Input>),
    /// A signed distance, written in code.
    Distance(Arc<dyn SignedDistance + Send + Sync>),
}

impl From<Surface> for BakeShape {
    fn from(surface: Surface) -> Self {
        Self::Input(Arc::new(Input::Surface(surface)))
    }
}

impl From<TetMesh> for BakeShape {
    fn from(tets: TetMesh) -> Self {
        Self::Input(Arc::new(Input::Tets(tets)))
    }
}

impl fmt::Debug for BakeShape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "File({})", path.display()),
            Self::Input(_) => f.write_str("Input(..)"),
            Self::Distance(_) => f.write_str("Distance(..)"),
        }
    }
}

/// The visible surface of a body that is baked.
#[derive(Clone, Debug, Default)]
pub enum BakeSkin {
    /// The boundary of the tetrahedra.
    #[default]
    Tetrahedra,
    /// The surface that was filled, with its texture coordinates. A shape that is no surface has none: refused.
    Shape,
    /// Another surface file, embedded in the tetrahedra.
    File(PathBuf),
    /// Another surface.
    Surface(Arc<Surface>),
}

/// How far a [`BakeRequest`] is.
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum BakeProgress {
    /// Others are before it.
    #[default]
    Waiting,
    /// It is being made.
    Running {
        /// Which part of the work.
        stage: BakeStage,
        /// How much of that part is done, 0 to 1.
        share: f32,
    },
    /// The [`ModalBody`](crate::ModalBody) has its model.
    Done {
        /// How long it took, s.
        seconds: f64,
        /// It was not baked but read: the same had been baked before.
        cached: bool,
        /// What was mended of a dirty surface before it was filled. `None`: nothing had to be.
        #[reflect(ignore)]
        repair: Option<Repair>,
    },
    /// There is no model. The error itself is in [`BakeFailed`].
    Failed {
        /// What was expected and what came.
        reason: String,
    },
}

/// The parts of a bake, in order.
#[derive(Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Clone, PartialEq)]
pub enum BakeStage {
    /// Reading, and filling with tetrahedra.
    Mesh,
    /// Elements, ordering, stiffness and mass.
    Assemble,
    /// The sparse factorisation.
    Factor,
    /// The modes.
    Modes,
    /// The visible surface and what a hand feels there.
    Surface,
}

/// Why a body could not be baked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BakeBodyError {
    /// The shape or the skin could not be read, or not be filled with tetrahedra.
    #[error("the body could not be meshed: {0}")]
    Mesh(#[from] MeshError),
    /// The bake was refused.
    #[error("the body could not be baked: {0}")]
    Bake(#[from] BakeError),
    /// [`BakeSkin::Shape`] of something that is no surface.
    #[error("the body cannot wear its shape as a skin: expected a surface, got {got}")]
    NoSurface {
        /// What the shape is.
        got: &'static str,
    },
    /// The system gave no threads.
    #[error("the body could not be baked: no threads were to be had: {0}")]
    Threads(String),
}

/// Sent, and logged with the entity's name, when a [`BakeRequest`] gave no model. The entity keeps the body it had.
#[derive(Message, Reflect, Debug)]
#[reflect(from_reflect = false)]
pub struct BakeFailed {
    /// The entity of the request.
    pub entity: Entity,
    /// What was expected and what came.
    #[reflect(ignore)]
    pub error: BakeBodyError,
}

//! Bake requests, their progress and their errors.

use std::{fmt, path::PathBuf, sync::Arc};

use bevy::prelude::*;
use pliant_bake::{AnchorSyntax, BakeConfig, BakeError, MaterialSyntax, RegionSyntax};
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
/// The [`ModalBody`](crate::ModalBody) on the same entity may have any settings. The bake writes
/// its model when the model is ready, and adds a `ModalBody` if there is none. A new model replaces
/// an old one like any change of the handle: the body begins at rest, and grabs stay.
///
/// A world that is saved by reflection does not have its requests, which may hold code.
#[derive(Component, Reflect, Debug, Clone)]
#[reflect(opaque)]
#[reflect(Debug, Clone)]
#[require(BakeProgress)]
pub struct BakeRequest {
    /// The shape that is filled with tetrahedra.
    pub shape: BakeShape,
    /// Approximate number of tetrahedra, for a shape without its own tetrahedra. Default: 10,000.
    pub tets: usize,
    /// The visible surface. Default: [`BakeSkin::Tetrahedra`].
    pub skin: BakeSkin,
    /// The material, the number of modes and the anchors. Default: [`BakeConfig::default`], a free
    /// body of soft silicone.
    pub config: BakeConfig,
}

impl BakeRequest {
    /// Returns a request for `shape` with all other fields at their defaults.
    pub fn new(shape: BakeShape) -> Self {
        Self { shape, tets: 10_000, skin: BakeSkin::default(), config: BakeConfig::default() }
    }

    /// Returns a request for a mesh of the engine, see [`BakeShape::Meshes`]. The mesh is also the
    /// visible surface.
    pub fn mesh(mesh: Handle<Mesh>) -> Self {
        Self::meshes([mesh])
    }

    /// Returns a request for several meshes of the engine that are one body, such as the primitives
    /// of a glTF mesh. They are also the visible surface. [`BakeNode`](crate::BakeNode) makes such
    /// a request of a node and keeps its materials.
    pub fn meshes(meshes: impl IntoIterator<Item = Handle<Mesh>>) -> Self {
        let shape = BakeShape::Meshes(meshes.into_iter().collect());
        Self { skin: BakeSkin::Shape, ..Self::new(shape) }
    }

    /// Returns a request for a file, see [`BakeShape::File`].
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Self::new(BakeShape::File(path.into()))
    }
}

/// The shape of a body before its bake.
#[derive(Clone)]
pub enum BakeShape {
    /// A file on disk: a surface (`.obj`, `.stl`, `.ply`, `.gltf`, `.glb`), a scene of rounded
    /// parts (`.ron`) or tetrahedra (`.msh`, `.vtk`, `.mesh`, `.veg`). A defective surface is
    /// repaired. A relative path starts in the working directory, not in the asset folder. What is
    /// painted in a glTF file ([`Paint::ATTRIBUTES`](pliant_bake::Paint::ATTRIBUTES)) becomes the
    /// request's [`BakeConfig::paint`], unless that is given.
    File(PathBuf),
    /// Meshes of the engine, such as `assets.load("bird.glb#Mesh0/Primitive0")`, in their own
    /// space. Together they enclose the body.
    ///
    /// The bake begins when they are loaded. Skins and morph targets have no effect on the shape.
    /// What is painted as [`ATTRIBUTE_STIFFNESS`],
    /// [`ATTRIBUTE_DENSITY`] and [`ATTRIBUTE_ANCHOR`](super::ATTRIBUTE_ANCHOR) becomes the
    /// request's [`BakeConfig::paint`], unless that is given. A later change of a mesh does
    /// not start a new bake.
    ///
    /// [`ATTRIBUTE_STIFFNESS`]: super::ATTRIBUTE_STIFFNESS
    /// [`ATTRIBUTE_DENSITY`]: super::ATTRIBUTE_DENSITY
    Meshes(Vec<Handle<Mesh>>),
    /// A surface, a scene or tetrahedra in memory.
    Input(Arc<Input>),
    /// A signed distance function in code.
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
            Self::Meshes(meshes) => f.debug_tuple("Meshes").field(meshes).finish(),
            Self::Input(_) => f.write_str("Input(..)"),
            Self::Distance(_) => f.write_str("Distance(..)"),
        }
    }
}

/// The visible surface of a baked body.
#[derive(Clone, Debug, Default)]
pub enum BakeSkin {
    /// The boundary of the tetrahedra.
    #[default]
    Tetrahedra,
    /// The surface that was filled, with its texture coordinates. A shape that is not a surface is
    /// refused.
    Shape,
    /// Another surface file, embedded in the tetrahedra.
    File(PathBuf),
    /// Another surface in memory.
    Surface(Arc<Surface>),
}

/// The progress of a [`BakeRequest`].
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum BakeProgress {
    /// Other requests are before this one.
    #[default]
    Waiting,
    /// The bake is running.
    Running {
        /// Current part of the work.
        stage: BakeStage,
        /// Completed fraction of that part, 0 to 1.
        share: f32,
    },
    /// The [`ModalBody`](crate::ModalBody) has its model.
    Done {
        /// Duration of the bake, s.
        seconds: f64,
        /// Whether the model was read from the cache of earlier bakes.
        cached: bool,
        /// Repair of a defective surface before it was filled. `None` if no repair was necessary.
        #[reflect(ignore)]
        repair: Option<Repair>,
    },
    /// The bake gave no model. [`BakeFailed`] holds the error.
    Failed {
        /// Text of the error: the expected and the actual input.
        reason: String,
    },
}

/// The parts of a bake, in order.
#[derive(Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Clone, PartialEq)]
pub enum BakeStage {
    /// Reading the shape and filling it with tetrahedra.
    Mesh,
    /// Elements, ordering, stiffness and mass.
    Assemble,
    /// The sparse factorization.
    Factor,
    /// The modes.
    Modes,
    /// The derivatives of the modes and the energy of a material for large strains.
    Material,
    /// The visible surface and the data for contact with a hand on it.
    Surface,
}

/// The reason why a body could not be baked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BakeBodyError {
    /// The shape or the skin could not be read, or the shape could not be filled with tetrahedra.
    #[error("the body could not be meshed: {0}")]
    Mesh(#[from] MeshError),
    /// The bake was refused.
    #[error("the body could not be baked: {0}")]
    Bake(#[from] BakeError),
    /// An anchor of [`BakeSettings`](crate::BakeSettings) cannot be read.
    #[error("{0}")]
    Anchor(#[from] AnchorSyntax),
    /// A region of [`BakeSettings`](crate::BakeSettings) cannot be read.
    #[error("{0}")]
    Region(#[from] RegionSyntax),
    /// There is no such material.
    #[error("{0}")]
    Material(#[from] MaterialSyntax),
    /// The skin is [`BakeSkin::Shape`], but the shape is not a surface.
    #[error("the body cannot wear its shape as a skin: expected a surface, got {got}")]
    NoSurface {
        /// The kind of the shape.
        got: &'static str,
    },
    /// A mesh of a [`BakeShape::Meshes`] could not be loaded.
    #[error("the mesh of the body could not be loaded: {0}")]
    Load(String),
    /// A mesh of a [`BakeShape::Meshes`] has no triangles, or a [`BakeNode`](crate::BakeNode) has
    /// no mesh.
    #[error("the body cannot be made from this mesh: expected {expected}")]
    UnusableMesh {
        /// What was expected.
        expected: &'static str,
    },
    /// The operating system provided no threads.
    #[error("the body could not be baked: no threads were to be had: {0}")]
    Threads(String),
}

/// Reports a [`BakeRequest`] that gave no model. Observe it on the entity or on all.
///
/// The plugin triggers this event and logs it with the entity's name. The entity keeps its previous
/// body.
#[derive(EntityEvent, Reflect, Debug)]
#[reflect(Debug, from_reflect = false)]
pub struct BakeFailed {
    /// The entity of the request.
    pub entity: Entity,
    /// The error: the expected and the actual input.
    #[reflect(ignore)]
    pub error: BakeBodyError,
}

//! Modal soft bodies without an engine.
//!
//! The crate holds the baked [`ModalModel`], its `.modal` file and the [`Body`]. A body steps its
//! model, takes grabs, reports reactions in newtons, bends by modal warping and writes its deformed
//! surface.
//!
//! A bake reduces a body to a few vibration modes. At run time only the modal coordinates `q` move:
//!
//! ```text
//! q'' + c q' + omega^2 q = f        one scalar equation a mode, mass-normalized (phi^T M phi = 1)
//! u(x) = R~(Psi(x) q) Phi(x) q      the displacement, warped (Choi and Ko 2005)
//! ```
//!
//! ```no_run
//! use std::sync::Arc;
//! use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = Arc::new(ModalModel::read("assets/pip.modal")?);
//! let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / 240.0, ..Default::default() })?;
//! let grab = body.grab(&Patch::around(model.surface(), 0, 0.02)?, GrabConfig::default())?;
//! let start = body.grab_position(grab)?;
//! for _ in 0..240 {
//!     body.set_target(grab, [start[0] + 0.05, start[1], start[2]])?;
//!     body.step()?;
//! }
//! println!("the hand feels {:?} N", body.reaction(grab)?);
//! # Ok(())
//! # }
//! ```
//!
//! The crate depends on no engine, clock or network. A step allocates nothing.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod basis;
mod body;
mod check;
mod contact;
pub mod cubature;
mod error;
mod exponential;
mod file;
mod flexibility;
mod held;
mod integrator;
mod islands;
mod limit;
mod model;
mod moments;
mod nonlinear;
mod patch;
mod relaxation;
mod saved;
mod simd;
mod step;
mod surface;
pub mod tetrahedron;
mod warp;

pub use basis::{BLOCK, Basis, Precision, ROWS};
pub use body::{Body, BodyConfig, GrabId};
pub use contact::{
    AttachedTo, AttachmentId, Capsule, Contact, ContactMemory, ContactReport, ContactState, Contacts, Cuboid,
    DistanceGrid, FixedObstacle, FixedShape, Moving, ObstacleShape, Plane, Probe, ProbeConfig, ProbeContact,
    Rigid, Sphere, Support, SurfacePoint, Touched, contact_force,
};
pub use error::{FileError, ModelError, StepError};
pub use file::{FORMAT_VERSION, MAGIC};
pub use held::{HeldPlace, HeldShapes, SimulationMesh, VertexPlace};
pub use integrator::{Coefficients, Integrator};
pub use islands::{Islands, Together};
pub use limit::streaming_sum;
pub use model::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelHash, ModelParts};
pub use nonlinear::{ElasticEnergy, Hyperelastic, Material, ReducedElasticity, positive_tangent};
pub use patch::Patch;
pub use relaxation::{Relaxation, ViscoelasticCoefficients};
pub use saved::SavedBody;
pub use step::{
    Elasticity, Frame, FrameMotion, GrabConfig, Hand, HeldPatch, Hold, ImpliedPulls, Kernel, Load,
    RigidMotion, State, StepReport, StepSettings,
};
pub use surface::SurfaceMesh;
pub use warp::{warp, warp_jacobian};

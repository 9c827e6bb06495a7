//! Contact of bodies with obstacles and with each other: where a body may touch, what it touches,
//! and the law of a contact.
//!
//! A body touches at its *contact sites*, patches of its surface that are spread evenly. A contact
//! is a hand with a cone: the force `f` (N) on a site and the position `y` (m) of its surface after
//! the step obey
//!
//! ```text
//! y = x* + sum A f + C f        x*: position without contacts, A: response of the bodies,
//!                               C: residual flexibility of the site and of what it touches
//! gap(y) >= 0,  f_n >= 0,  f_n gap(y) = 0          Signorini, along the normal
//! |f_t| <= mu f_n,  y_t at its anchor or sliding   Coulomb, in the tangent plane
//! ```
//!
//! Where a part of the surface is a part of a sphere, it touches an obstacle at one place, which
//! moves over the sphere and is carried by the sites around it. `C` is then the dent of Hertz,
//! which is not linear.
//!
//! The tangential law holds positions, not velocities: a site that sticks has an *anchor*, so a
//! body at rest on an incline does not creep. The laws of all contacts are solved together by block
//! Gauss-Seidel in modal space, with the exact solution of each block.
//!
//! Two bodies touch with the sites of each at the surface of the other. A point is pulled back to
//! the rest shape of the other body through its deformation. `y` is then the position of one
//! surface relative to the other, and `A` and `C` have the responses of both bodies.

mod attachment;
mod cone;
mod contacts;
mod distance_grid;
mod fixed;
mod indent;
mod obstacle;
mod point;
mod probe;
mod rigid;
mod shape;
mod sites;
mod solver;
mod surface_field;

pub use attachment::{AttachedTo, AttachmentId};
pub use cone::contact_force;
pub use contacts::{Contact, ContactMemory, ContactReport, ContactState, Contacts, Touched};
pub use distance_grid::DistanceGrid;
pub use fixed::{FixedObstacle, FixedShape};
pub use obstacle::{Capsule, Cuboid, Moving, ObstacleShape, Plane, Sphere, SurfacePoint};
pub use probe::{Probe, ProbeConfig, ProbeContact};
pub use rigid::{Rigid, Support};

pub(crate) use attachment::Attachment;
pub(crate) use indent::Indent;
pub(crate) use point::{AtAttachment, AtProbe, AtRigid, AtSupport, ContactPoint, Far, Memory};
pub(crate) use probe::{Grown, ProbeMemory, Spot};
pub(crate) use rigid::Pushed;
pub(crate) use shape::{Guess, Near, Shape, Sixes};
pub(crate) use sites::{ContactSites, Site};
pub(crate) use solver::{Clearance, Look, Touching};
pub(crate) use surface_field::{ALONG, Bent, Carriers, Cloud, Place, Side, closest_on_triangle};

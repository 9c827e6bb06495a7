//! Contact of a body with obstacles: where a body may touch, what it touches, and the law of a
//! contact.
//!
//! A body touches at its *contact sites*, patches of its surface that are spread evenly. A contact
//! is a hand with a cone: the force `f` (N) on a site and the position `y` (m) of its surface after
//! the step obey
//!
//! ```text
//! y = x* + sum A f + C f        x*: position without contacts, A: response of the body,
//!                               C: residual flexibility of the site
//! gap(y) >= 0,  f_n >= 0,  f_n gap(y) = 0          Signorini, along the normal
//! |f_t| <= mu f_n,  y_t at its anchor or sliding   Coulomb, in the tangent plane
//! ```
//!
//! The tangential law holds positions, not velocities: a site that sticks has an *anchor*, so a
//! body at rest on an incline does not creep. The laws of all contacts are solved together by block
//! Gauss-Seidel in modal space, with the exact solution of each block.

mod cone;
mod contacts;
mod obstacle;
mod sites;

pub use contacts::{Contact, ContactReport, Contacts};
pub use obstacle::{Capsule, Cuboid, Moving, Obstacle, Plane, Sphere, SurfacePoint};

pub(crate) use contacts::{Memory, Point, Touching};
pub(crate) use sites::{ContactSites, Site};

//! Shapes that are given by their signed distance.

mod scene;
mod shapes;
mod surface;

pub use scene::Scene;
pub use surface::SurfaceDistance;

/// Solid shape that returns the distance of any point from its surface.
pub trait SignedDistance: Sync {
    /// Returns the signed distance from `p` (m) to the surface, m: negative inside, positive
    /// outside, zero on the surface.
    ///
    /// The magnitude may be less than the true distance but never more: all points within it of `p`
    /// lie on the same side of the surface. (A function that changes by at most 1 m per meter has
    /// this property.)
    fn distance(&self, p: [f64; 3]) -> f64;

    /// Returns the lowest and highest corner of a box that contains the whole shape, m.
    fn bounds(&self) -> [[f64; 3]; 2];
}

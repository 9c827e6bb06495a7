//! Shapes given by their distance.

mod scene;
mod shapes;
mod surface;

pub use scene::Scene;
pub use surface::SurfaceDistance;

/// A solid shape that knows how far any point is from its surface.
pub trait SignedDistance: Sync {
    /// Distance from `p` (m) to the surface in m: negative inside, positive outside, zero on the surface.
    ///
    /// The size may be less than the true distance, never more: whatever lies within it of `p` is on one side of the
    /// surface. (A function that changes by at most 1 m a metre has this property.)
    fn distance(&self, p: [f64; 3]) -> f64;

    /// Lowest and highest corner of a box, in m, that holds the whole shape.
    fn bounds(&self) -> [[f64; 3]; 2];
}

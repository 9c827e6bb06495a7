//! Shapes that are given by their signed distance.

mod scene;
mod shapes;
mod surface;

use nalgebra::Vector3;

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

    /// Returns a point of the surface that is close to `p`, m.
    ///
    /// The default goes down the slope of the distance a few times, which suits smooth surfaces.
    fn closest(&self, p: [f64; 3]) -> [f64; 3] {
        let [low, high] = self.bounds().map(Vector3::from);
        let step = 1e-6 * (high - low).norm();
        let mut at = Vector3::from(p);
        for _ in 0..4 {
            let distance = self.distance(at.into());
            let slope = Vector3::from_fn(|axis, _| {
                let mut beside = [at; 2];
                beside[0][axis] -= step;
                beside[1][axis] += step;
                let [before, after] = beside.map(|p| self.distance(p.into()));
                (after - before) / (2.0 * step)
            });
            let squared = slope.norm_squared();
            // Where the slope vanishes, as on a medial axis, no way leads to the surface.
            if !(squared > 1e-6 && distance.is_finite()) {
                break;
            }
            at -= slope * (distance / squared.max(1.0));
        }
        at.into()
    }

    /// Returns the volume and the area of the shape if they are known. The default is `None`.
    fn extent(&self) -> Option<Extent> {
        None
    }
}

/// Volume and area of a shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Enclosed volume, m^3.
    pub volume: f64,
    /// Area of the surface, m^2.
    pub area: f64,
}

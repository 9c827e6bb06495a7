//! Closest points of a surface.

use nalgebra::{Matrix2, Vector2, Vector3};

use crate::{MeshError, Surface, bvh::Bvh};

/// Closest point of a surface, as a place on one of its triangles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosestPoint {
    /// Index of the triangle.
    pub triangle: u32,
    /// Weights of the triangle's corners, at least 0, with the sum 1.
    pub weights: [f64; 3],
    /// Distance from the point that was asked for, m.
    pub distance: f64,
}

/// Finds the closest points of a surface, which may be open.
#[derive(Debug)]
pub struct SurfaceLocator {
    bvh: Bvh,
    corners: Vec<[Vector3<f64>; 3]>,
}

impl SurfaceLocator {
    /// Prepares a surface.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::check`].
    pub fn new(surface: &Surface) -> Result<Self, MeshError> {
        surface.check()?;
        let corners: Vec<[Vector3<f64>; 3]> = surface.corners().collect();
        Ok(Self { bvh: Bvh::new(&corners), corners })
    }

    /// Returns the point of the surface that is closest to `point` (m). Among equally close points
    /// the choice is deterministic.
    pub fn closest(&self, point: [f64; 3]) -> ClosestPoint {
        let found = self.bvh.closest(Vector3::from(point));
        let [a, b, c] = self.corners[found.triangle as usize];
        let (u, v, w) = (b - a, c - a, found.point - a);
        let metric = Matrix2::new(u.dot(&u), u.dot(&v), u.dot(&v), v.dot(&v));
        // A triangle without area has its closest point on an edge: the nearest corner stands for
        // it.
        let place = metric.try_inverse().map(|inverse| inverse * Vector2::new(u.dot(&w), v.dot(&w)));
        let weights = match place {
            Some(p) if p.iter().all(|x| x.is_finite()) => {
                let [s, t] = [p[0].clamp(0.0, 1.0), p[1].clamp(0.0, 1.0)];
                let sum = (s + t).max(1.0);
                [(1.0 - s - t).max(0.0), s / sum, t / sum]
            }
            _ => {
                let far = [a, b, c].map(|corner| (corner - found.point).norm_squared());
                let nearest = (0..3).min_by(|&i, &j| far[i].total_cmp(&far[j])).unwrap_or(0);
                std::array::from_fn(|k| f64::from(u8::from(k == nearest)))
            }
        };
        ClosestPoint { triangle: found.triangle, weights, distance: found.distance }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    #[test]
    fn the_weights_give_the_closest_point() {
        let ball = shapes::sphere(24, 1.0).unwrap().boundary().0;
        let locator = SurfaceLocator::new(&ball).unwrap();
        for i in 0..200 {
            let p = [0, 1, 2].map(|k| 1.7 * (f64::from(i) * [1.3, 2.1, 0.7][k]).sin());
            let found = locator.closest(p);
            let corners = ball.triangles[found.triangle as usize].map(|v| ball.positions[v as usize]);
            let at: [f64; 3] =
                std::array::from_fn(|k| (0..3).map(|c| found.weights[c] * corners[c][k]).sum());
            let gap = (0..3).map(|k| (at[k] - p[k]).powi(2)).sum::<f64>().sqrt();
            assert!((gap - found.distance).abs() < 1e-9, "{gap} and {}", found.distance);
            assert!((found.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            // The closest point of a ball lies towards the point; facets are off by 1 %.
            let length = p.iter().map(|x| x * x).sum::<f64>().sqrt();
            assert!((found.distance - (length - 1.0).abs()).abs() < 0.01, "{length}");
        }
    }

    #[test]
    fn an_open_surface_and_a_flat_triangle_have_closest_points() {
        let surface = Surface {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            triangles: vec![[0, 1, 2], [0, 1, 3]],
            uvs: None,
        };
        let locator = SurfaceLocator::new(&surface).unwrap();
        let found = locator.closest([2.0, -1.0, 0.0]);
        assert_eq!((found.triangle, found.weights), (0, [0.0, 0.0, 1.0]));
        let inside = locator.closest([0.25, 0.25, 3.0]);
        assert_eq!(inside.triangle, 1);
        assert!((inside.weights[0] - 0.5).abs() < 1e-12 && (inside.distance - 3.0).abs() < 1e-12);
    }
}

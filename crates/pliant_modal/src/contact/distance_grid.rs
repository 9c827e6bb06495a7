//! A solid whose signed distance is known at the nodes of a grid.

use nalgebra::Vector3;

use super::{ObstacleShape, SurfacePoint, obstacle::direction};
use crate::{StepError, error::finite};

/// Largest number of nodes: 256 MiB of them.
const MOST: usize = 1 << 26;

/// By how much more than the distance of two nodes their values may differ, as a share of it. Room
/// for single precision, and for a distance that is itself interpolated.
const SLACK: f64 = 0.01;

/// The thirteen directions to the nodes of the cells around a node, one of each pair of opposite
/// ones.
const NEIGHBORS: [[isize; 3]; 13] = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [1, 1, 0],
    [1, -1, 0],
    [1, 0, 1],
    [1, 0, -1],
    [0, 1, 1],
    [0, 1, -1],
    [1, 1, 1],
    [1, 1, -1],
    [1, -1, 1],
    [1, -1, -1],
];

/// A solid of any shape, given by its signed distance at the nodes of a grid. A query takes the
/// same time whatever the shape is.
///
/// Between the nodes the distance is that of Catmull and Rom's cubic splines along the three axes
/// ("A class of local interpolating splines", 1974), so that it has no steps and no kinks. It is
/// exact for planes, off by a share of the cell at edges, and by `cell^2 / R` or less on a surface
/// of radius `R`. What is thinner than two cells may be missing.
///
/// The outermost layer of cells only serves those within it. Beyond these, the distance is a lower
/// bound if the solid reaches none of the two outermost layers of nodes. Otherwise it goes on
/// without end, as the surface does at the nearest place of the inner cells: a terrain ends in
/// slopes.
#[derive(Debug, Clone, PartialEq)]
pub struct DistanceGrid {
    origin: Vector3<f64>,
    cell: f64,
    counts: [usize; 3],
    values: Vec<f32>,
    /// Whether the solid reaches the two outermost layers of nodes.
    open: bool,
}

impl DistanceGrid {
    /// Takes the distances (m) at the nodes `origin + cell [i, j, k]` (m), `counts` of them along
    /// each axis. `i` changes fastest.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] if a number is not finite, the cell is not above zero, there
    /// are fewer than four nodes along an axis or another number of values, or if two neighbors
    /// differ by more than their distance, also across a cell: no solid has such distances, and a
    /// body that is fast could pass through.
    pub fn new(origin: [f64; 3], cell: f64, counts: [usize; 3], values: Vec<f32>) -> Result<Self, StepError> {
        finite("origin of a distance grid", &origin)?;
        let sound = cell > 0.0 && cell.is_finite();
        StepError::check("cell of a distance grid", "finite meters above 0", sound, cell)?;
        let fewest = counts.iter().copied().min().unwrap_or(0);
        StepError::check(
            "nodes of a distance grid",
            "4 or more along each axis",
            fewest >= 4,
            fewest as f64,
        )?;
        let all = counts.iter().try_fold(1usize, |all, count| all.checked_mul(*count));
        let expected = "as many as nodes, and at most 2^26";
        let sound = all == Some(values.len()) && values.len() <= MOST;
        StepError::check("values of a distance grid", expected, sound, values.len() as f64)?;
        let bad = values.iter().find(|value| !value.is_finite()).copied();
        StepError::check(
            "value of a distance grid",
            "finite meters",
            bad.is_none(),
            bad.unwrap_or(0.0).into(),
        )?;
        let mut field = Self { origin: origin.into(), cell, counts, values, open: false };
        let steepest = field.steepest();
        let expected = "neighbors that differ by their distance at most";
        StepError::check("slope of a distance grid", expected, steepest <= 1.0 + SLACK, steepest)?;
        let outer = |axis: usize, node: usize| node < 2 || node + 2 >= counts[axis];
        let mut nodes = field.values.iter().enumerate();
        field.open = nodes.any(|(at, value)| {
            let node = [at % counts[0], at / counts[0] % counts[1], at / (counts[0] * counts[1])];
            *value <= 0.0 && (0..3).any(|axis| outer(axis, node[axis]))
        });
        Ok(field)
    }

    /// Samples a distance (m) at the nodes of a grid with a given cell (m) that covers the box from
    /// `low` to `high` (m), and three cells more on each side.
    ///
    /// # Errors
    /// Returns the errors of [`DistanceGrid::new`], and one for more than 2^26 nodes.
    pub fn sample(
        [low, high]: [[f64; 3]; 2],
        cell: f64,
        mut distance: impl FnMut([f64; 3]) -> f64,
    ) -> Result<Self, StepError> {
        const MARGIN: f64 = 3.0;
        finite("corner of a distance grid", &[low, high].concat())?;
        let wide: [f64; 3] =
            std::array::from_fn(|k| ((high[k] - low[k]).max(0.0) / cell).ceil() + 2.0 * MARGIN);
        let all = wide.iter().map(|cells| cells + 1.0).product::<f64>();
        // Comparisons with no number are false.
        let sound = cell > 0.0 && all <= MOST as f64;
        StepError::check("nodes of a distance grid", "at most 2^26, of a cell above 0", sound, all)?;
        let counts = wide.map(|cells| cells as usize + 1);
        let origin: [f64; 3] = std::array::from_fn(|k| {
            // The box lies in the middle.
            0.5 * (low[k] + high[k]) - 0.5 * wide[k] * cell
        });
        let mut values = Vec::with_capacity(counts.iter().product());
        for k in 0..counts[2] {
            for j in 0..counts[1] {
                for i in 0..counts[0] {
                    let node = [i, j, k];
                    let at = std::array::from_fn(|axis| origin[axis] + cell * node[axis] as f64);
                    values.push(distance(at) as f32);
                }
            }
        }
        Self::new(origin, cell, counts, values)
    }

    /// The cell of the grid, m.
    pub fn cell(&self) -> f64 {
        self.cell
    }

    /// The largest difference of two nodes of a cell, as a share of their distance.
    fn steepest(&self) -> f64 {
        let [nx, ny, _] = self.counts;
        let mut steepest = 0.0f64;
        for (at, value) in self.values.iter().enumerate() {
            let node = [at % nx, at / nx % ny, at / (nx * ny)];
            for step in NEIGHBORS {
                let other: [Option<usize>; 3] = std::array::from_fn(|k| {
                    node[k].checked_add_signed(step[k]).filter(|n| *n < self.counts[k])
                });
                let [Some(x), Some(y), Some(z)] = other else { continue };
                let apart = step.iter().map(|k| (k * k) as f64).sum::<f64>().sqrt();
                let other = self.values[x + nx * (y + ny * z)];
                steepest = steepest.max(f64::from(other - value).abs() / apart);
            }
        }
        steepest / self.cell
    }

    /// The spline and its gradient at a point within the inner cells.
    fn spline(&self, point: &Vector3<f64>) -> (f64, Vector3<f64>) {
        let local = (point - self.origin) / self.cell;
        let first: [usize; 3] = std::array::from_fn(|k| (local[k].max(1.0) as usize).min(self.counts[k] - 3));
        let [x, y, z] = std::array::from_fn(|k| weights(local[k] - first[k] as f64));
        let mut sum = [0.0; 4];
        for (k, (wz, dz)) in z.into_iter().enumerate() {
            for (j, (wy, dy)) in y.into_iter().enumerate() {
                let row =
                    first[0] - 1 + self.counts[0] * (first[1] - 1 + j + self.counts[1] * (first[2] - 1 + k));
                let (mut value, mut slope) = (0.0, 0.0);
                for (node, (wx, dx)) in self.values[row..row + 4].iter().zip(x) {
                    value += wx * f64::from(*node);
                    slope += dx * f64::from(*node);
                }
                sum[0] += wz * wy * value;
                sum[1] += wz * wy * slope;
                sum[2] += wz * dy * value;
                sum[3] += dz * wy * value;
            }
        }
        let [value, gradient @ ..] = sum;
        (value, Vector3::from(gradient) / self.cell)
    }
}

/// Weights of the four nodes around `t`, 0 to 1 between the two in the middle, and their
/// derivatives.
fn weights(t: f64) -> [(f64, f64); 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        (0.5 * (-t + 2.0 * t2 - t3), 0.5 * (-1.0 + 4.0 * t - 3.0 * t2)),
        (0.5 * (2.0 - 5.0 * t2 + 3.0 * t3), 0.5 * (-10.0 * t + 9.0 * t2)),
        (0.5 * (t + 4.0 * t2 - 3.0 * t3), 0.5 * (1.0 + 8.0 * t - 9.0 * t2)),
        (0.5 * (-t2 + t3), 0.5 * (-2.0 * t + 3.0 * t2)),
    ]
}

impl ObstacleShape for DistanceGrid {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let inner = |k: usize, node: usize| self.origin[k] + self.cell * node as f64;
        let within = Vector3::from_fn(|k, _| point[k].clamp(inner(k, 1), inner(k, self.counts[k] - 2)));
        let (distance, gradient) = self.spline(&within);
        let (_, normal) = direction(gradient, Vector3::y());
        let beyond = point - within;
        if beyond == Vector3::zeros() {
            return SurfacePoint { distance, normal };
        }
        if self.open {
            return SurfacePoint { distance: distance + normal.dot(&beyond), normal };
        }
        // The solid lies within the grid, a convex box: whatever is `distance` from the box's
        // nearest point is at least the hypotenuse from here.
        let along = Vector3::from_fn(|k, _| if beyond[k] == 0.0 { normal[k] } else { 0.0 });
        let (_, normal) = direction(beyond + distance * along, normal);
        SurfacePoint { distance: beyond.norm().hypot(distance), normal }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contact::{Cuboid, Plane, Sphere};

    fn points(wide: f64) -> impl Iterator<Item = Vector3<f64>> {
        (1..2000).map(move |i| {
            let at = |k: f64| wide * (f64::from(i) * k).sin();
            Vector3::new(at(0.7), at(1.3), at(2.1))
        })
    }

    fn field(shape: &impl ObstacleShape, half: f64, cell: f64) -> DistanceGrid {
        DistanceGrid::sample([[-half; 3], [half; 3]], cell, |p| shape.at(&p.into()).distance).unwrap()
    }

    /// The error falls with the square of the cell, and the normal is the gradient.
    #[test]
    fn a_ball_on_a_grid_is_that_ball() {
        let ball = Sphere { center: [0.02, -0.03, 0.01], radius: 0.4 };
        for cell in [0.05, 0.025] {
            let field = field(&ball, 0.45, cell);
            for point in points(0.5) {
                let (found, exact) = (field.at(&point), ball.at(&point));
                // The spline is exact to third order: what is left is of the center's kink.
                let radius = exact.distance + ball.radius;
                let most = if radius > 3.0 * cell { 0.02 * cell * cell / radius } else { cell };
                assert!((found.distance - exact.distance).abs() < most, "{cell} {point}: {}", found.distance);
                if radius > 0.2 && found.distance < 0.05 {
                    assert!((found.normal - exact.normal).norm() < 0.05, "{cell} {point}");
                    let slope = Vector3::from_fn(|axis, _| {
                        let step = Vector3::ith(axis, 1e-6);
                        (field.at(&(point + step)).distance - field.at(&(point - step)).distance) / 2e-6
                    });
                    assert!((slope - found.normal).norm() < 0.01, "{cell} {point}: {slope}");
                }
            }
        }
    }

    #[test]
    fn a_plane_is_exact_and_a_terrain_goes_on_without_end() {
        let plane = Plane { point: [0.0, 0.1, 0.0], normal: [0.3, 1.0, -0.2] };
        let field = field(&plane, 0.5, 0.1);
        for point in points(0.7) {
            let (found, exact) = (field.at(&point), plane.at(&point));
            assert!((found.distance - exact.distance).abs() < 1e-6, "{point}");
            assert!((found.normal - exact.normal).norm() < 1e-5, "{point}");
        }
        // Beyond the grid in every direction, too, without a jump.
        for point in points(30.0) {
            let (found, exact) = (field.at(&point), plane.at(&point));
            assert!((found.distance - exact.distance).abs() < 1e-3, "{point}: {}", found.distance);
        }
    }

    /// What slides off a terrain comes to a slope, and not to a step.
    #[test]
    fn a_terrain_has_no_jump_at_its_edge() {
        let hill = |p: [f64; 3]| (p[1] - 0.1 * (3.0 * p[0]).sin() * (2.0 * p[2]).cos()) / 1.1;
        let field = DistanceGrid::sample([[-0.5; 3], [0.5; 3]], 0.05, hill).unwrap();
        for i in 1..2000 {
            let at = |k: f64| 0.9 * (f64::from(i) * k).sin();
            // The inner cells end at 0.6.
            let point = Vector3::new(0.6 * at(0.3).signum(), at(1.3), at(2.1));
            let [inner, outer] = [-1e-6, 1e-6].map(|way| field.at(&(point * (1.0 + way))).distance);
            assert!((inner - outer).abs() < 1e-5, "{point}: {inner} and {outer}");
        }
    }

    /// A body that is far away and fast must not be told that it is farther than it is.
    #[test]
    fn beyond_the_grid_the_distance_is_no_more_than_the_true_one() {
        let cuboid = Cuboid {
            center: [0.1, 0.0, 0.0],
            rotation: [0.1, 0.3, -0.2, 0.9],
            half: [0.3, 0.1, 0.2],
            round: 0.0,
        };
        let cell = 0.04;
        let field = field(&cuboid, 0.45, cell);
        let mut outside = 0;
        for point in points(3.0) {
            let (found, exact) = (field.at(&point), cuboid.at(&point));
            // Deep inside, where two faces are equally near, the spline is round.
            let round = if exact.distance < -cell { 0.3 * cell } else { 0.1 * cell };
            assert!(found.distance <= exact.distance + round, "{point}: {}", found.distance);
            assert!(
                found.distance >= exact.distance.min(0.5 * exact.distance) - cell,
                "{point}: {}",
                found.distance
            );
            assert!((found.normal.norm() - 1.0).abs() < 1e-12);
            outside += u32::from(point.amax() > 0.6);
        }
        assert!(outside > 1000);
    }

    #[test]
    fn numbers_that_are_no_distances_are_refused() {
        let field = |cell, counts: [usize; 3], value: fn(usize) -> f32| {
            DistanceGrid::new([0.0; 3], cell, counts, (0..counts.iter().product()).map(value).collect())
        };
        assert!(field(0.1, [4, 5, 6], |_| 0.3).is_ok());
        assert!(field(0.0, [4, 5, 6], |_| 0.3).is_err());
        assert!(field(f64::NAN, [4, 5, 6], |_| 0.3).is_err());
        assert!(field(0.1, [3, 5, 6], |_| 0.3).is_err());
        assert!(field(0.1, [4, 5, 6], |i| if i == 7 { f32::NAN } else { 0.3 }).is_err());
        // A value that jumps.
        assert!(field(0.1, [4, 5, 6], |i| if i == 7 { 0.5 } else { 0.3 }).is_err());
        // Along the axes its slope is one, and across the cells more.
        let taxi = |p: [f64; 3]| p.iter().map(|x| x.abs()).sum::<f64>() - 0.3;
        assert!(DistanceGrid::sample([[-0.5; 3], [0.5; 3]], 0.1, taxi).is_err());
        assert!(DistanceGrid::new([0.0; 3], 0.1, [4, 4, 4], vec![0.0; 63]).is_err());
        assert!(DistanceGrid::new([0.0; 3], 0.1, [usize::MAX, 4, 4], vec![0.0; 63]).is_err());
        assert!(DistanceGrid::sample([[0.0; 3], [1.0; 3]], 1e-9, |_| 0.0).is_err());
        assert!(DistanceGrid::sample([[0.0; 3], [1.0; 3]], -1.0, |_| 0.0).is_err());
        assert!(DistanceGrid::sample([[0.0; 3], [1e300; 3]], 0.1, |_| 0.0).is_err());
    }
}

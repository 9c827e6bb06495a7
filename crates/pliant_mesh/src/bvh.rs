//! Bounding volume hierarchy over triangles: closest point, winding number and pairs of triangles
//! that may touch.

use nalgebra::Vector3;

type Triangle = [Vector3<f64>; 3];

const LEAF: usize = 4;

/// Distance, in radii of a node, beyond which the node's triangles act as one dipole (beta in
/// Barill et al. 2018).
const FAR: f64 = 2.3;

/// Bounding volume hierarchy over a non-empty list of triangles.
#[derive(Debug)]
pub(crate) struct Bvh {
    nodes: Vec<BvhNode>,
    /// Triangles in the order of the leaves. `numbers` holds their original indices.
    triangles: Vec<Triangle>,
    numbers: Vec<u32>,
}

#[derive(Debug)]
struct BvhNode {
    low: Vector3<f64>,
    high: Vector3<f64>,
    /// First triangle below the node. `count` is the number of these triangles.
    first: u32,
    count: u32,
    /// Index of the second child, or 0 for a leaf. The first child directly follows its parent.
    second: u32,
    /// Sum of the triangles' area vectors, m^2. `center` is the point where the sum acts.
    area: Vector3<f64>,
    center: Vector3<f64>,
    /// Radius around `center` that contains all triangles of the node.
    radius: f64,
}

/// Part of a triangle that is closest to a point. Corners count from 0, and edge `i` runs from
/// corner `i` to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Feature {
    Face,
    Edge(usize),
    Corner(usize),
}

/// Closest point of the triangles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Closest {
    pub(crate) triangle: u32,
    pub(crate) feature: Feature,
    pub(crate) point: Vector3<f64>,
    pub(crate) distance: f64,
}

impl Bvh {
    pub(crate) fn new(triangles: &[Triangle]) -> Self {
        let mut numbers: Vec<u32> = (0..triangles.len() as u32).collect();
        let centers: Vec<Vector3<f64>> = triangles.iter().map(|t| (t[0] + t[1] + t[2]) / 3.0).collect();
        let mut nodes = Vec::with_capacity(triangles.len());
        build(&mut nodes, triangles, &centers, &mut numbers, 0);
        let triangles = numbers.iter().map(|&n| triangles[n as usize]).collect();
        Self { nodes, triangles, numbers }
    }

    /// Returns the point of the triangles that is closest to `p`. Among equally close points, the
    /// first in the tree wins.
    pub(crate) fn closest(&self, p: Vector3<f64>) -> Closest {
        let mut best = Closest { triangle: 0, feature: Feature::Face, point: p, distance: f64::INFINITY };
        let mut best_squared = f64::INFINITY;
        // Each split halves the list exactly, so the stack holds at most 2 log2(2^32 / LEAF)
        // entries.
        let mut stack = [(0_u32, 0.0_f64); 64];
        let mut top = 1;
        stack[0] = (0, self.nodes[0].distance_squared(p));
        while top > 0 {
            top -= 1;
            let (index, bound) = stack[top];
            if bound >= best_squared {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.second == 0 {
                for i in node.first..node.first + node.count {
                    let (point, feature) = closest_on_triangle(p, &self.triangles[i as usize]);
                    let squared = (point - p).norm_squared();
                    if squared < best_squared {
                        best_squared = squared;
                        best = Closest { triangle: self.numbers[i as usize], feature, point, distance: 0.0 };
                    }
                }
                continue;
            }
            let children = [index + 1, node.second].map(|c| (c, self.nodes[c as usize].distance_squared(p)));
            // The nearer child goes on top of the stack, so that the loop visits it first.
            let [near, far] =
                if children[0].1 <= children[1].1 { children } else { [children[1], children[0]] };
            stack[top] = far;
            stack[top + 1] = near;
            top += 2;
        }
        best.distance = best_squared.sqrt();
        best
    }

    /// Returns how often the triangles wind around `p`: 1 inside a closed, outward surface and 0
    /// outside.
    ///
    /// The winding number is the sum of the triangles' solid angles over 4 pi (Jacobson et al.
    /// 2013). Far triangles are evaluated together (Barill et al. 2018).
    pub(crate) fn winding_number(&self, p: Vector3<f64>) -> f64 {
        let mut angle = 0.0;
        let mut stack = [0_u32; 64];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let index = stack[top];
            let node = &self.nodes[index as usize];
            let away = node.center - p;
            let squared = away.norm_squared();
            if squared > (FAR * node.radius).powi(2) {
                angle += node.area.dot(&away) / (squared * squared.sqrt());
            } else if node.second == 0 {
                let leaf = node.first as usize..(node.first + node.count) as usize;
                angle += self.triangles[leaf].iter().map(|t| solid_angle(p, t)).sum::<f64>();
            } else {
                stack[top] = node.second;
                stack[top + 1] = index + 1;
                top += 2;
            }
        }
        angle / (4.0 * std::f64::consts::PI)
    }

    /// Calls `visit` with the indices of all pairs of different triangles whose leaves' boxes
    /// overlap.
    pub(crate) fn for_each_overlap(&self, mut visit: impl FnMut(u32, u32)) {
        let mut stack = vec![(0_u32, 0_u32)];
        while let Some((a, b)) = stack.pop() {
            let (node_a, node_b) = (&self.nodes[a as usize], &self.nodes[b as usize]);
            if a != b && !node_a.overlaps(node_b) {
                continue;
            }
            match (node_a.second, node_b.second) {
                (0, 0) => {
                    for i in node_a.first..node_a.first + node_a.count {
                        let start = if a == b { i + 1 } else { node_b.first };
                        for j in start..node_b.first + node_b.count {
                            visit(self.numbers[i as usize], self.numbers[j as usize]);
                        }
                    }
                }
                (second, _) if a == b => stack.extend([(a + 1, a + 1), (second, second), (a + 1, second)]),
                (0, second) => stack.extend([(a, b + 1), (a, second)]),
                (second, 0) => stack.extend([(a + 1, b), (second, b)]),
                // The larger node is opened first.
                (second, _) if node_a.count >= node_b.count => stack.extend([(a + 1, b), (second, b)]),
                (_, second) => stack.extend([(a, b + 1), (a, second)]),
            }
        }
    }
}

impl BvhNode {
    fn distance_squared(&self, p: Vector3<f64>) -> f64 {
        (0..3).map(|a| (self.low[a] - p[a]).max(p[a] - self.high[a]).max(0.0).powi(2)).sum()
    }

    fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|a| self.low[a] <= other.high[a] && other.low[a] <= self.high[a])
    }
}

/// Appends the tree over `numbers`, a part of the list that starts at `first`.
fn build(
    nodes: &mut Vec<BvhNode>,
    triangles: &[Triangle],
    centers: &[Vector3<f64>],
    numbers: &mut [u32],
    first: usize,
) {
    let corners = || numbers.iter().flat_map(|&n| triangles[n as usize]);
    let low = corners().fold(Vector3::repeat(f64::INFINITY), |a, b| a.inf(&b));
    let high = corners().fold(Vector3::repeat(f64::NEG_INFINITY), |a, b| a.sup(&b));
    let mut area = Vector3::zeros();
    let (mut center, mut weight) = (Vector3::zeros(), 0.0);
    for &n in numbers.iter() {
        let [a, b, c] = triangles[n as usize];
        let vector = 0.5 * (b - a).cross(&(c - a));
        area += vector;
        center += vector.norm() * centers[n as usize];
        weight += vector.norm();
    }
    let center = if weight > 0.0 { center / weight } else { (low + high) / 2.0 };
    let radius = corners().map(|p| (p - center).norm()).fold(0.0, f64::max);
    let index = nodes.len();
    let count = numbers.len();
    nodes.push(BvhNode {
        low,
        high,
        first: first as u32,
        count: count as u32,
        second: 0,
        area,
        center,
        radius,
    });
    if count <= LEAF {
        return;
    }
    let axis = numbers
        .iter()
        .map(|&n| centers[n as usize])
        .fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(l, h), c| {
            (l.inf(&c), h.sup(&c))
        });
    let axis = (axis.1 - axis.0).imax();
    let half = count / 2;
    numbers.select_nth_unstable_by(half, |&a, &b| {
        centers[a as usize][axis].total_cmp(&centers[b as usize][axis]).then(a.cmp(&b))
    });
    let (left, right) = numbers.split_at_mut(half);
    build(nodes, triangles, centers, left, first);
    nodes[index].second = nodes.len() as u32;
    build(nodes, triangles, centers, right, first + half);
}

/// Returns the closest point of a triangle and the feature on which it lies.
///
/// The method uses the Voronoi regions of the features (Ericson, *Real-Time Collision Detection*,
/// 5.1.5).
fn closest_on_triangle(p: Vector3<f64>, &[a, b, c]: &Triangle) -> (Vector3<f64>, Feature) {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return (a, Feature::Corner(0));
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return (b, Feature::Corner(1));
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return (a + ab * (d1 / (d1 - d3)), Feature::Edge(0));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return (c, Feature::Corner(2));
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return (a + ac * (d2 / (d2 - d6)), Feature::Edge(2));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return (b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6))), Feature::Edge(1));
    }
    let sum = va + vb + vc;
    (a + ab * (vb / sum) + ac * (vc / sum), Feature::Face)
}

/// Returns the solid angle of a triangle seen from `p`, positive from behind (van Oosterom and
/// Strackee 1983).
fn solid_angle(p: Vector3<f64>, t: &Triangle) -> f64 {
    let [a, b, c] = t.map(|v| v - p);
    let (la, lb, lc) = (a.norm(), b.norm(), c.norm());
    let triple = a.dot(&b.cross(&c));
    2.0 * triple.atan2(la * lb * lc + a.dot(&b) * lc + b.dot(&c) * la + c.dot(&a) * lb)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    fn ball() -> Vec<Triangle> {
        let (surface, _) = shapes::sphere(8, 1.0).unwrap().boundary();
        surface.triangles.iter().map(|t| t.map(|v| Vector3::from(surface.positions[v as usize]))).collect()
    }

    /// Returns points in and around the unit ball.
    fn points() -> impl Iterator<Item = Vector3<f64>> {
        // The additive recurrence of the plastic number covers the box evenly.
        (1..400).map(|n| {
            let x = |a: f64| (f64::from(n) * a).fract() * 3.0 - 1.5;
            Vector3::new(x(0.819_172_513), x(0.671_043_606), x(0.549_700_478))
        })
    }

    #[test]
    fn the_closest_point_is_what_a_search_of_all_triangles_finds() {
        let triangles = ball();
        let bvh = Bvh::new(&triangles);
        for p in points() {
            let found = bvh.closest(p);
            let all = triangles
                .iter()
                .map(|t| (closest_on_triangle(p, t).0 - p).norm())
                .fold(f64::INFINITY, f64::min);
            assert!((found.distance - all).abs() < 1e-14, "{p:?}");
            assert!(
                (closest_on_triangle(p, &triangles[found.triangle as usize]).0 - found.point).norm() < 1e-14
            );
        }
    }

    #[test]
    fn the_winding_number_is_1_inside_and_0_outside() {
        let triangles = ball();
        let bvh = Bvh::new(&triangles);
        for p in points() {
            let exact: f64 =
                triangles.iter().map(|t| solid_angle(p, t)).sum::<f64>() / (4.0 * std::f64::consts::PI);
            let inside = if p.norm() < 0.98 { 1.0 } else { 0.0 };
            if !(0.98..1.0).contains(&p.norm()) {
                assert!((exact - inside).abs() < 1e-12, "{p:?}");
            }
            // Barill et al. state an error of a few percent for dipoles.
            assert!((bvh.winding_number(p) - exact).abs() < 0.02, "{p:?}");
        }
    }

    #[test]
    fn overlaps_are_each_found_once() {
        let triangles = ball();
        let bvh = Bvh::new(&triangles);
        let mut pairs = Vec::new();
        bvh.for_each_overlap(|a, b| pairs.push((a.min(b), a.max(b))));
        let count = pairs.len();
        pairs.sort_unstable();
        pairs.dedup();
        assert_eq!(pairs.len(), count);
        // The pairs must include all neighbors.
        assert!(triangles.iter().enumerate().all(|(i, t)| triangles[..i].iter().enumerate().all(
            |(j, u)| {
                t.iter().all(|p| !u.contains(p)) || pairs.binary_search(&(j as u32, i as u32)).is_ok()
            }
        )));
    }
}

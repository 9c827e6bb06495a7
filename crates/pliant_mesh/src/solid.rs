//! Surfaces that bound a solid: closed, with outward winding and without self-crossings.

use std::collections::HashMap;

use nalgebra::Vector3;

use crate::{MeshError, Surface, bvh::Bvh};

/// Fraction of its longest edge squared below which a triangle's area counts as zero.
const FLAT: f64 = 1e-12;
/// Fraction of their size by which triangles must pass each other to count as crossing. Smaller
/// overlaps are rounding errors.
const CROSSING: f64 = 1e-10;

impl Surface {
    /// Returns the surface as the boundary of a solid.
    ///
    /// Vertices at the same position are merged (texture seams, STL). Unused vertices and texture
    /// coordinates are left out, and triangles face outward. Where several closed parts lie inside
    /// each other, each must have the right winding. A single part that is inside out is turned.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::check`], and [`MeshError::FlatTriangle`],
    /// [`MeshError::Open`], [`MeshError::NonManifoldEdge`], [`MeshError::Orientation`] or
    /// [`MeshError::SelfCrossing`]. The last error holds the triangle indices of `self`.
    pub fn closed(&self) -> Result<Self, MeshError> {
        self.check()?;
        let mut solid = self.merged();
        solid.check_areas()?;
        solid.check_edges()?;
        solid.check_crossings()?;
        if solid.volume() < 0.0 {
            for t in &mut solid.triangles {
                t.swap(1, 2);
            }
        }
        Ok(solid)
    }

    /// Merges vertices at the same position and keeps the order of first use.
    pub(crate) fn merged(&self) -> Self {
        let mut vertex_at = HashMap::new();
        let mut merged = Self::default();
        for t in &self.triangles {
            merged.triangles.push(t.map(|v| {
                let p = self.positions[v as usize];
                // Adding 0 turns -0 into 0, so that both have the same bits.
                *vertex_at.entry(p.map(|x| (x + 0.0).to_bits())).or_insert_with(|| {
                    merged.positions.push(p);
                    merged.positions.len() as u32 - 1
                })
            }));
        }
        merged
    }

    fn check_areas(&self) -> Result<(), MeshError> {
        for (triangle, corners) in self.corners().enumerate() {
            if !has_area(&corners) {
                let [a, b, c] = corners;
                let area = 0.5 * (b - a).cross(&(c - a)).norm();
                return Err(MeshError::FlatTriangle { triangle, area, at: ((a + b + c) / 3.0).into() });
            }
        }
        Ok(())
    }

    /// Checks that each edge has two triangles with the same winding.
    pub(crate) fn check_edges(&self) -> Result<(), MeshError> {
        // Each entry is an edge from its lower vertex and whether its triangle runs in this
        // direction.
        let mut edges: Vec<([u32; 2], bool)> = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| ([a.min(b), a.max(b)], a < b))
            .collect();
        edges.sort_unstable();
        let ends = |edge: [u32; 2]| edge.map(|v| self.positions[v as usize]);
        let (mut open, mut flipped) = (Vec::new(), Vec::new());
        for same in edges.chunk_by(|a, b| a.0 == b.0) {
            match same {
                [(edge, _)] => open.push(ends(*edge)),
                [(edge, x), (_, y)] if x == y => flipped.push(ends(*edge)),
                [_, _] => {}
                _ => {
                    let [from, to] = ends(same[0].0);
                    return Err(MeshError::NonManifoldEdge { triangles: same.len(), from, to });
                }
            }
        }
        if let Some(&[from, to]) = open.first() {
            return Err(MeshError::Open { edges: open.len(), from, to });
        }
        if let Some(&[from, to]) = flipped.first() {
            return Err(MeshError::Orientation { edges: flipped.len(), from, to });
        }
        Ok(())
    }

    fn check_crossings(&self) -> Result<(), MeshError> {
        let triangles: Vec<[Vector3<f64>; 3]> = self.corners().collect();
        let mut found = Vec::new();
        Bvh::new(&triangles).for_each_overlap(|i, j| {
            let (a, b) = (i.min(j), i.max(j));
            let shared = |x: u32, y: u32| {
                let other = self.triangles[y as usize];
                self.triangles[x as usize].map(|v| other.contains(&v))
            };
            let crossing = crossing(&triangles[a as usize], shared(a, b), &triangles[b as usize])
                .or_else(|| crossing(&triangles[b as usize], shared(b, a), &triangles[a as usize]));
            if let Some(at) = crossing {
                found.push((a, b, at));
            }
        });
        match found.iter().min_by_key(|f| (f.0, f.1)) {
            None => Ok(()),
            Some(&(first, second, at)) => Err(MeshError::SelfCrossing {
                pairs: found.len(),
                first: first as usize,
                second: second as usize,
                at: at.into(),
            }),
        }
    }
}

/// Returns whether a triangle's area is finite and not negligible.
pub(crate) fn has_area([a, b, c]: &[Vector3<f64>; 3]) -> bool {
    let area = 0.5 * (b - a).cross(&(c - a)).norm();
    let longest = (b - a).norm_squared().max((c - b).norm_squared()).max((a - c).norm_squared());
    area.is_finite() && area > FLAT * longest
}

/// Returns the point where an edge of triangle `a` passes through triangle `b`. Edges with a
/// `shared` corner only touch `b`.
fn crossing(a: &[Vector3<f64>; 3], shared: [bool; 3], b: &[Vector3<f64>; 3]) -> Option<Vector3<f64>> {
    let normal = (b[1] - b[0]).cross(&(b[2] - b[0]));
    for i in 0..3 {
        let j = (i + 1) % 3;
        if shared[i] || shared[j] {
            continue;
        }
        let (p, q) = (a[i], a[j]);
        // These values are six times the volumes of p and q with the triangle, and of the edge with
        // each side of the triangle.
        let (height_p, height_q) = (normal.dot(&(p - b[0])), normal.dot(&(q - b[0])));
        let tolerance = CROSSING * normal.norm() * ((q - p).norm() + normal.norm().sqrt());
        if height_p.abs() <= tolerance || height_q.abs() <= tolerance || (height_p > 0.0) == (height_q > 0.0)
        {
            continue;
        }
        let sides: [f64; 3] = std::array::from_fn(|k| {
            let (u, v) = (b[k] - p, b[(k + 1) % 3] - p);
            (q - p).dot(&u.cross(&v))
        });
        // An edge that passes through another edge counts, because meshes that mirror each other
        // cross only in such points.
        if sides.iter().all(|&s| s > -tolerance) || sides.iter().all(|&s| s < tolerance) {
            return Some(p + (q - p) * (height_p / (height_p - height_q)));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    fn ball(cells: usize) -> Surface {
        shapes::sphere(cells, 0.5).unwrap().boundary().0
    }

    fn moved(mut surface: Surface, by: f64) -> Surface {
        for p in &mut surface.positions {
            p[0] += by;
        }
        surface
    }

    fn both(mut a: Surface, b: Surface) -> Surface {
        let offset = a.positions.len() as u32;
        a.positions.extend(b.positions);
        a.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + offset)));
        a
    }

    #[test]
    fn a_surface_that_is_inside_out_is_turned() {
        let ball = ball(4);
        assert_eq!(ball.closed().unwrap().triangles.len(), ball.triangles.len());
        let mut turned = ball.clone();
        turned.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert!(turned.volume() < 0.0);
        assert!((turned.closed().unwrap().volume() - ball.volume()).abs() < 1e-15);
    }

    #[test]
    fn a_soup_of_triangles_becomes_one_surface() {
        let ball = ball(3);
        let soup = Surface {
            positions: ball.triangles.iter().flatten().map(|&v| ball.positions[v as usize]).collect(),
            triangles: (0..ball.triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            uvs: None,
        };
        assert_eq!(soup.closed().unwrap().positions.len(), ball.positions.len());
    }

    #[test]
    fn a_missing_triangle_is_an_open_surface() {
        let mut open = ball(4);
        open.triangles.remove(7);
        assert!(matches!(open.closed(), Err(MeshError::Open { edges: 3, .. })));
    }

    #[test]
    fn a_flipped_triangle_is_named() {
        let mut flipped = ball(4);
        flipped.triangles[7].swap(0, 1);
        assert!(matches!(flipped.closed(), Err(MeshError::Orientation { edges: 3, .. })));
    }

    #[test]
    fn a_doubled_triangle_is_not_a_manifold() {
        let mut doubled = ball(4);
        doubled.triangles.push(doubled.triangles[3]);
        assert!(matches!(doubled.closed(), Err(MeshError::NonManifoldEdge { triangles: 3, .. })));
    }

    #[test]
    fn a_flat_triangle_is_named() {
        let mut flat = ball(2);
        let [a, b, _] = flat.triangles[5];
        flat.triangles[5] = [a, b, b];
        assert!(matches!(flat.closed(), Err(MeshError::FlatTriangle { triangle: 5, .. })));
    }

    #[test]
    fn parts_may_lie_apart_but_not_cross() {
        let apart = both(ball(4), moved(ball(4), 1.01));
        assert!((apart.closed().unwrap().volume() - 2.0 * ball(4).volume()).abs() < 1e-12);
        let crossing = both(ball(4), moved(ball(4), 0.7));
        let Err(MeshError::SelfCrossing { pairs, at, .. }) = crossing.closed() else { panic!("not refused") };
        assert!(pairs > 4);
        assert!((at[0] - 0.35).abs() < 0.1, "{at:?}");
    }

    #[test]
    fn a_spike_through_the_own_surface_is_a_crossing() {
        let mut spike = ball(6);
        // One vertex of the right side is moved out through the left side.
        let top = (0..spike.positions.len())
            .max_by(|&a, &b| spike.positions[a][0].total_cmp(&spike.positions[b][0]));
        spike.positions[top.unwrap()] = [-0.8, 0.013, 0.017];
        assert!(matches!(spike.closed(), Err(MeshError::SelfCrossing { .. })));
    }
}

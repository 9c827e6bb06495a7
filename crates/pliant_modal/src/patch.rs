//! A patch: the area of the surface that a hand holds.
//!
//! A hand holds an area instead of a single vertex. The compliance at a point of an elastic
//! continuum is infinite, so on a mesh the compliance of a single vertex would depend on the mesh.

use std::collections::VecDeque;

use crate::{ModelError, SurfaceMesh};

/// Weighted surface vertices around a center. The weights are positive and sum to one.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    center: u32,
    radius: f64,
    entries: Vec<(u32, f64)>,
}

impl Patch {
    /// Makes the patch of `radius` (m) around surface vertex `vertex`, on the rest shape.
    ///
    /// The weight of a vertex is the area around the vertex times `(1 - d^2 / r^2)^2`, where `d` is
    /// its distance from the center. Only vertices that can be reached over edges within the radius
    /// count, so two fingers that touch at rest stay separate. If the radius is below the edge
    /// length, the patch is the center vertex alone.
    ///
    /// # Errors
    /// Returns an error if the surface does not have the vertex, or if the radius is negative or
    /// not finite.
    pub fn around(surface: &SurfaceMesh, vertex: u32, radius: f64) -> Result<Self, ModelError> {
        let count = surface.positions().len();
        if vertex as usize >= count {
            return Err(ModelError::Vertex { what: "patch", index: 0, vertex, count });
        }
        if !(radius.is_finite() && radius >= 0.0) {
            return Err(ModelError::Value {
                what: "patch radius",
                index: 0,
                expected: "finite meters, 0 or more",
                got: radius,
            });
        }
        let at = |v: u32| surface.positions()[v as usize].map(f64::from);
        let center = at(vertex);
        let distance2 = |v: u32| {
            let p = at(v);
            (0..3).map(|k| (p[k] - center[k]).powi(2)).sum::<f64>()
        };
        let r2 = radius * radius;
        let mut reached = vec![false; surface.welded_count()];
        let mut queue = VecDeque::from([vertex]);
        reached[surface.welded()[vertex as usize] as usize] = true;
        let mut entries = Vec::new();
        while let Some(v) = queue.pop_front() {
            let w = surface.welded()[v as usize];
            let d2 = distance2(v);
            let kernel = if r2 > 0.0 { (1.0 - (d2 / r2).min(1.0)).powi(2) } else { 0.0 };
            let weight = kernel * surface.area_around(v);
            if v == vertex || weight > 0.0 {
                entries.push((v, weight));
            }
            for &t in surface.ring(w) {
                for &n in &surface.triangles()[t as usize] {
                    let wn = surface.welded()[n as usize] as usize;
                    if !reached[wn] && distance2(n) < r2 {
                        reached[wn] = true;
                        queue.push_back(n);
                    }
                }
            }
        }
        entries.sort_by_key(|&(v, _)| v);
        let total: f64 = entries.iter().map(|&(_, w)| w).sum();
        if total > 0.0 && total.is_finite() {
            entries.iter_mut().for_each(|(_, w)| *w /= total);
        } else {
            entries = vec![(vertex, 1.0)];
        }
        Ok(Self { center: vertex, radius, entries })
    }

    /// The vertex at the center of the patch.
    pub fn center(&self) -> u32 {
        self.center
    }

    /// The radius that was requested, m.
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// Surface vertices and their weights, in ascending order of vertex. The weights sum to one.
    pub fn entries(&self) -> &[(u32, f64)] {
        &self.entries
    }
}

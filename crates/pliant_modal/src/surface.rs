//! The visible surface at rest: triangles, texture coordinates and vertex adjacency.

use std::collections::HashMap;

use nalgebra::Vector3;

use crate::{ModelError, contact::closest_on_triangle};

/// A triangle surface at rest in body axes (m), with the adjacency that patches and normals need.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceMesh {
    positions: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    uvs: Option<Vec<[f32; 2]>>,
    anchored: Vec<bool>,
    /// Index of the welded vertex of each vertex. Vertices at the same place (texture seams) share
    /// one welded vertex, so that normals and patches do not depend on seams.
    welded: Vec<u32>,
    welded_count: usize,
    /// Triangles around each welded vertex, compressed: `ring[ring_start[w]..ring_start[w + 1]]`.
    ring_start: Vec<u32>,
    ring: Vec<u32>,
}

impl SurfaceMesh {
    /// Checks and indexes a surface.
    ///
    /// `uvs` and `anchored` have one entry per vertex. An empty `anchored` means that no vertex is
    /// fixed.
    ///
    /// # Errors
    /// Returns an error if there is no vertex or no triangle, if a length does not match, if a
    /// position or texture coordinate is not finite, or if a triangle names a missing vertex.
    pub fn new(
        positions: Vec<[f32; 3]>,
        triangles: Vec<[u32; 3]>,
        uvs: Option<Vec<[f32; 2]>>,
        mut anchored: Vec<bool>,
    ) -> Result<Self, ModelError> {
        if positions.is_empty() {
            return Err(ModelError::Empty("surface vertex"));
        }
        if triangles.is_empty() {
            return Err(ModelError::Empty("surface triangle"));
        }
        let count = positions.len();
        if anchored.is_empty() {
            anchored = vec![false; count];
        }
        check_length("anchored", count, anchored.len())?;
        if let Some(uvs) = &uvs {
            check_length("uvs", count, uvs.len())?;
            for (index, uv) in uvs.iter().enumerate() {
                if let Some(bad) = uv.iter().find(|x| !x.is_finite()) {
                    return Err(value("uvs", index, "finite", f64::from(*bad)));
                }
            }
        }
        for (index, p) in positions.iter().enumerate() {
            if let Some(bad) = p.iter().find(|x| !x.is_finite()) {
                return Err(value("surface positions", index, "finite meters", f64::from(*bad)));
            }
        }
        for (index, t) in triangles.iter().enumerate() {
            if let Some(&vertex) = t.iter().find(|&&v| v as usize >= count) {
                return Err(ModelError::Vertex { what: "surface triangles", index, vertex, count });
            }
        }

        let mut seen: HashMap<[u32; 3], u32> = HashMap::with_capacity(count);
        let mut welded = Vec::with_capacity(count);
        for p in &positions {
            // Adding 0.0 turns -0.0 into 0.0, so that both have the same key.
            let key = p.map(|x| (x + 0.0).to_bits());
            let next = seen.len() as u32;
            welded.push(*seen.entry(key).or_insert(next));
        }
        let welded_count = seen.len();

        let mut ring_start = vec![0u32; welded_count + 1];
        for t in &triangles {
            for &v in t {
                ring_start[welded[v as usize] as usize + 1] += 1;
            }
        }
        for i in 0..welded_count {
            ring_start[i + 1] += ring_start[i];
        }
        let mut fill = ring_start.clone();
        let mut ring = vec![0u32; triangles.len() * 3];
        for (index, t) in triangles.iter().enumerate() {
            for &v in t {
                let slot = &mut fill[welded[v as usize] as usize];
                ring[*slot as usize] = index as u32;
                *slot += 1;
            }
        }
        Ok(Self { positions, triangles, uvs, anchored, welded, welded_count, ring_start, ring })
    }

    /// Rest positions, m.
    pub fn positions(&self) -> &[[f32; 3]] {
        &self.positions
    }

    /// Vertex triples of the triangles, counter-clockwise seen from outside.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Texture coordinates, one per vertex, if the surface has them.
    pub fn uvs(&self) -> Option<&[[f32; 2]]> {
        self.uvs.as_deref()
    }

    /// Whether each vertex is fixed by an anchor.
    pub fn anchored(&self) -> &[bool] {
        &self.anchored
    }

    /// Index of the welded vertex of each vertex. Vertices at the same place (texture seams) share
    /// one.
    pub fn welded(&self) -> &[u32] {
        &self.welded
    }

    /// Number of welded vertices, which is the number of distinct vertex positions.
    pub fn welded_count(&self) -> usize {
        self.welded_count
    }

    /// The triangles around welded vertex `w`. Empty if there is no such vertex.
    pub fn ring(&self, w: u32) -> &[u32] {
        let w = w as usize;
        if w >= self.welded_count {
            return &[];
        }
        &self.ring[self.ring_start[w] as usize..self.ring_start[w + 1] as usize]
    }

    /// A third of the area of the triangles around a vertex, m^2, including the triangles of
    /// vertices that are welded to it.
    pub(crate) fn area_around(&self, vertex: u32) -> f64 {
        let area = |&t: &u32| {
            let [a, b, c] = self.triangles[t as usize].map(|v| self.positions[v as usize].map(f64::from));
            let u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
            let v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
            let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            0.5 * (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt()
        };
        self.ring(self.welded[vertex as usize]).iter().map(area).sum::<f64>() / 3.0
    }

    /// Smallest and largest corner of the bounds of the rest shape, m.
    pub fn bounds(&self) -> [[f32; 3]; 2] {
        let mut low = [f32::INFINITY; 3];
        let mut high = [f32::NEG_INFINITY; 3];
        for p in &self.positions {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        [low, high]
    }

    /// The triangle that is nearest to a point (m, body axes) at rest, and the weights of its three
    /// corners at the place nearest to the point. `None` for a point that is not finite. The
    /// function tests every triangle.
    pub fn nearest(&self, point: [f64; 3]) -> Option<(u32, [f64; 3])> {
        let point = Vector3::from(point);
        let place = |(index, triangle): (usize, &[u32; 3])| {
            let corners = triangle.map(|v| Vector3::from(self.positions[v as usize].map(f64::from)));
            let weights = closest_on_triangle(corners.each_ref(), &point);
            let there: Vector3<f64> = corners.iter().zip(weights).map(|(corner, w)| *corner * w).sum();
            let distance = (there - point).norm_squared();
            distance.is_finite().then_some((distance, index as u32, weights))
        };
        let all = self.triangles.iter().enumerate().filter_map(place);
        let (_, triangle, weights) = all.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((triangle, weights))
    }

    /// Largest extent of the bounds of the rest shape, m.
    pub fn size(&self) -> f64 {
        let [low, high] = self.bounds();
        (0..3).map(|k| f64::from(high[k]) - f64::from(low[k])).fold(0.0, f64::max)
    }

    /// Computes area-weighted vertex normals of a deformed shape of this surface, smooth over
    /// texture seams.
    ///
    /// A normal has unit length, or is zero where every triangle around a vertex has collapsed. The
    /// caller keeps `scratch`, so that a frame allocates nothing. If `positions` is shorter than
    /// the surface, nothing is written. Otherwise as many normals are written as `normals` and the
    /// surface both have.
    pub fn normals(&self, positions: &[[f32; 3]], normals: &mut [[f32; 3]], scratch: &mut Vec<[f32; 3]>) {
        if positions.len() < self.positions.len() {
            return;
        }
        scratch.clear();
        scratch.resize(self.welded_count, [0.0; 3]);
        for t in &self.triangles {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            let u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
            let v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
            let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            for &v in t {
                let sum = &mut scratch[self.welded[v as usize] as usize];
                for k in 0..3 {
                    sum[k] += n[k];
                }
            }
        }
        for sum in scratch.iter_mut() {
            // Dividing by the largest component first keeps the squares of tiny triangles from
            // underflowing.
            let largest = sum.iter().fold(0.0f32, |m, x| m.max(x.abs()));
            if largest > 0.0 && largest.is_finite() {
                let s = sum.map(|x| x / largest);
                let length = (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]).sqrt();
                *sum = s.map(|x| x / length);
            } else {
                *sum = [0.0; 3];
            }
        }
        for (n, &w) in normals.iter_mut().zip(&self.welded) {
            *n = scratch[w as usize];
        }
    }
}

fn check_length(what: &'static str, expected: usize, got: usize) -> Result<(), ModelError> {
    if expected == got { Ok(()) } else { Err(ModelError::Length { what, expected, got }) }
}

fn value(what: &'static str, index: usize, expected: &'static str, got: f64) -> ModelError {
    ModelError::Value { what, index, expected, got }
}

//! The division of a surface for drawing: drawn vertices and the vertices that share a normal.

use std::collections::HashMap;

use bevy::math::Vec3;
use pliant_modal::SurfaceMesh;

/// The drawn mesh of a surface.
///
/// Each smooth side of a surface vertex has its own drawn vertex: two on the edge of a box, one on
/// a sphere. All copies have the same position, so that there are no cracks.
#[derive(Debug)]
pub(super) struct Topology {
    /// For each drawn vertex, the vertex of the surface that it shows.
    pub source: Vec<u32>,
    /// For each drawn vertex, the index of its normal.
    pub normal: Vec<u32>,
    /// Number of normals.
    pub normals: usize,
    /// Triangles of drawn vertices.
    pub triangles: Vec<[u32; 3]>,
    /// The tangent of each drawn vertex. Empty for a surface without texture coordinates.
    pub tangents: Vec<Tangent>,
}

/// Tangent of a drawn vertex, as the direction in a triangle that moves with the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tangent {
    /// Surface vertices of the triangle.
    pub triangle: [u32; 3],
    /// Factors of the edges from its first vertex to the second and the third.
    pub edges: [f32; 2],
    /// Sign of the bitangent, `sign * (normal x tangent)`.
    pub sign: f32,
}

impl Tangent {
    /// Returns the tangent of a shape with these positions and this unit normal.
    pub fn of(&self, positions: &[[f32; 3]], normal: Vec3) -> [f32; 4] {
        let [a, b, c] = self.triangle.map(|v| Vec3::from(positions[v as usize]));
        let along = self.edges[0] * (b - a) + self.edges[1] * (c - a);
        let flat = along - normal * normal.dot(along);
        let unit = (flat / flat.abs().max_element()).try_normalize();
        let unit = unit.unwrap_or_else(|| normal.any_orthonormal_vector());
        [unit.x, unit.y, unit.z, self.sign]
    }
}

impl Topology {
    /// Returns the number of words on the GPU: two per drawn vertex, the start of each normal's
    /// corners, nine per triangle, and six per tangent.
    pub fn words(&self) -> usize {
        2 * self.source.len() + self.normals + 1 + 9 * self.triangles.len() + 6 * self.tangents.len()
    }

    /// Computes the tangents at rest: the mean direction in which the first texture coordinate
    /// grows, weighted by the angles of the corners.
    fn tangents(&self, surface: &SurfaceMesh, uvs: &[[f32; 2]]) -> Vec<Tangent> {
        let at = |v: u32| Vec3::from(surface.positions()[self.source[v as usize] as usize]);
        let mut normals = vec![Vec3::ZERO; self.normals];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(at);
            let face = (b - a).cross(c - a);
            triangle.iter().for_each(|&v| normals[self.normal[v as usize] as usize] += face);
        }
        let mut sums = vec![(Vec3::ZERO, 0.0f32, 0.0f32, 0usize); self.source.len()];
        for (index, triangle) in self.triangles.iter().enumerate() {
            let corners = triangle.map(at);
            let [a, b, c] = corners;
            let [p, q, r] = triangle.map(|v| uvs[self.source[v as usize] as usize]);
            let [du1, dv1, du2, dv2] = [q[0] - p[0], q[1] - p[1], r[0] - p[0], r[1] - p[1]];
            let turn = du1 * dv2 - du2 * dv1;
            let area = (b - a).cross(c - a).length();
            // Where the texture is degenerate, any direction serves.
            let along = if turn == 0.0 { b - a } else { ((b - a) * dv2 - (c - a) * dv1) * turn.signum() };
            for (k, &v) in triangle.iter().enumerate() {
                let normal = normals[self.normal[v as usize] as usize].normalize_or_zero();
                let flat = (along - normal * normal.dot(along)).normalize_or_zero();
                let [from, to] = [1, 2].map(|n| corners[(k + n) % 3] - corners[k]);
                let angle = from.angle_between(to);
                let angle = if angle.is_finite() { angle } else { 0.0 };
                let (sum, sign, largest, owner) = &mut sums[v as usize];
                *sum += angle * flat;
                *sign += angle * if turn < 0.0 { -1.0 } else { 1.0 };
                if area > *largest {
                    (*largest, *owner) = (area, index);
                }
            }
        }
        let tangent = |&(sum, sign, _, owner): &(Vec3, f32, f32, usize)| {
            let corners = self.triangles[owner];
            let [a, b, c] = corners.map(at);
            let (u, v) = (b - a, c - a);
            // Least squares, since the mean direction may leave the plane of the triangle.
            let [uu, uv, vv, us, vs] = [u.dot(u), u.dot(v), v.dot(v), u.dot(sum), v.dot(sum)];
            let determinant = uu * vv - uv * uv;
            let edges = [(vv * us - uv * vs) / determinant, (uu * vs - uv * us) / determinant];
            let edges = if edges.iter().all(|x| x.is_finite()) { edges } else { [1.0, 0.0] };
            Tangent {
                triangle: corners.map(|v| self.source[v as usize]),
                edges,
                sign: if sign < 0.0 { -1.0 } else { 1.0 },
            }
        };
        sums.iter().map(tangent).collect()
    }

    /// Returns the corners at each normal: the start of each normal's corners (one more entry than
    /// there are normals), and for each corner the three surface vertices of its triangle.
    pub fn corners(&self) -> (Vec<u32>, Vec<[u32; 3]>) {
        let mut starts = vec![0u32; self.normals + 1];
        for &v in self.triangles.iter().flatten() {
            starts[self.normal[v as usize] as usize + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut corners = vec![[0; 3]; self.triangles.len() * 3];
        for triangle in &self.triangles {
            let vertices = triangle.map(|v| self.source[v as usize]);
            for &v in triangle {
                let at = &mut next[self.normal[v as usize] as usize];
                corners[*at as usize] = vertices;
                *at += 1;
            }
        }
        (starts, corners)
    }

    /// Divides `surface` along the edges where the rest shape bends by more than `crease` (rad).
    /// Texture seams stay smooth.
    pub fn new(surface: &SurfaceMesh, crease: f32) -> Self {
        let triangles = surface.triangles();
        let welded = surface.welded();
        let face_normals: Vec<[f32; 3]> =
            triangles.iter().map(|t| face_normal(surface.positions(), t)).collect();
        let flattest = crease.cos();

        // A corner is a triangle at one of its vertices. Corners that meet across a smooth edge
        // share a normal.
        let mut sets = DisjointSets::new(triangles.len() * 3);
        let mut edges: HashMap<[u32; 2], (usize, usize, usize)> = HashMap::with_capacity(triangles.len() * 2);
        for (index, triangle) in triangles.iter().enumerate() {
            for k in 0..3 {
                let (from, to) = (index * 3 + k, index * 3 + (k + 1) % 3);
                let ends = [welded[triangle[k] as usize], welded[triangle[(k + 1) % 3] as usize]];
                let key = if ends[0] < ends[1] { ends } else { [ends[1], ends[0]] };
                let here = if ends == key { (index, from, to) } else { (index, to, from) };
                match edges.get(&key) {
                    None => {
                        edges.insert(key, here);
                    }
                    Some(&(other, low, high)) => {
                        let [a, b] = [face_normals[other], face_normals[index]];
                        if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] >= flattest {
                            sets.join(low, here.1);
                            sets.join(high, here.2);
                        }
                    }
                }
            }
        }

        let mut normal_of_set: HashMap<usize, u32> = HashMap::new();
        let mut drawn: HashMap<(u32, u32), u32> = HashMap::with_capacity(surface.positions().len());
        let (mut source, mut normal) = (Vec::new(), Vec::new());
        let mut drawn_triangles = Vec::with_capacity(triangles.len());
        for (index, triangle) in triangles.iter().enumerate() {
            drawn_triangles.push(std::array::from_fn(|k| {
                let set = sets.find(index * 3 + k);
                let next = normal_of_set.len() as u32;
                let group = *normal_of_set.entry(set).or_insert(next);
                *drawn.entry((triangle[k], group)).or_insert_with(|| {
                    source.push(triangle[k]);
                    normal.push(group);
                    source.len() as u32 - 1
                })
            }));
        }
        let mut topology = Self {
            source,
            normal,
            normals: normal_of_set.len(),
            triangles: drawn_triangles,
            tangents: Vec::new(),
        };
        if let Some(uvs) = surface.uvs() {
            topology.tangents = topology.tangents(surface, uvs);
        }
        topology
    }
}

fn face_normal(positions: &[[f32; 3]], triangle: &[u32; 3]) -> [f32; 3] {
    let [a, b, c] = triangle.map(|v| bevy::math::Vec3::from(positions[v as usize]));
    (b - a).cross(c - a).normalize_or_zero().into()
}

struct DisjointSets(Vec<usize>);

impl DisjointSets {
    fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    fn find(&mut self, mut item: usize) -> usize {
        while self.0[item] != item {
            self.0[item] = self.0[self.0[item]];
            item = self.0[item];
        }
        item
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::{FRAC_PI_2, PI};

    fn cube() -> SurfaceMesh {
        let positions = (0..8).map(|i| [(i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32]).collect();
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        SurfaceMesh::new(positions, triangles, None, Vec::new()).unwrap()
    }

    #[test]
    fn a_cube_has_three_sides_at_each_corner_and_one_normal_a_face() {
        let topology = Topology::new(&cube(), FRAC_PI_2 * 0.9);
        assert_eq!((topology.source.len(), topology.triangles.len()), (24, 12));
        // Each face has one normal at each of its corners.
        assert_eq!(topology.normals, 24);
        for (drawn, plain) in topology.triangles.iter().zip(cube().triangles()) {
            assert_eq!(&drawn.map(|v| topology.source[v as usize]), plain);
        }
    }

    #[test]
    fn a_cube_smoothed_over_keeps_its_eight_vertices() {
        let topology = Topology::new(&cube(), PI);
        assert_eq!((topology.source.len(), topology.normals), (8, 8));
    }

    /// On a plane whose texture is turned, stretched and mirrored, the tangent is the direction in
    /// which the first coordinate grows, and follows an affine motion exactly.
    #[test]
    fn tangents_follow_the_texture_and_the_motion() {
        let positions: Vec<[f32; 3]> = (0..9).map(|i| [(i % 3) as f32, (i / 3) as f32, 0.0]).collect();
        let triangles = (0..4)
            .map(|i| (i / 2) * 3 + i % 2)
            .flat_map(|a: u32| [[a, a + 1, a + 4], [a, a + 4, a + 3]])
            .collect::<Vec<_>>();
        let (sin, cos) = 0.4f32.sin_cos();
        for mirror in [1.0f32, -1.0] {
            let uv = |p: &[f32; 3]| [3.0 * (cos * p[0] + sin * p[1]), mirror * (cos * p[1] - sin * p[0])];
            let uvs = Some(positions.iter().map(uv).collect());
            let surface = SurfaceMesh::new(positions.clone(), triangles.clone(), uvs, Vec::new()).unwrap();
            let topology = Topology::new(&surface, 0.5);
            assert_eq!(topology.tangents.len(), topology.source.len());
            let moved: Vec<[f32; 3]> =
                positions.iter().map(|p| [2.0 * p[0] + 0.5 * p[1], 0.0, -p[1]]).collect();
            for tangent in &topology.tangents {
                let [x, y, z, sign] = tangent.of(&positions, Vec3::Z);
                assert!(Vec3::new(x, y, z).distance(Vec3::new(cos, sin, 0.0)) < 1e-5, "{x} {y} {z}");
                assert_eq!(sign, mirror);
                let [x, y, z, _] = tangent.of(&moved, Vec3::Y);
                let expected = Vec3::new(2.0 * cos + 0.5 * sin, 0.0, -sin).normalize();
                assert!(Vec3::new(x, y, z).distance(expected) < 1e-5, "{x} {y} {z}");
            }
        }
    }

    #[test]
    fn a_texture_without_extent_still_gives_unit_tangents() {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]];
        // The second triangle has no area.
        let uvs = Some(vec![[0.5; 2]; 4]);
        let surface =
            SurfaceMesh::new(positions.clone(), vec![[0, 1, 2], [1, 3, 2]], uvs, Vec::new()).unwrap();
        for tangent in &Topology::new(&surface, 0.5).tangents {
            for normal in [Vec3::Z, Vec3::X] {
                let [x, y, z, _] = tangent.of(&positions, normal);
                let tangent = Vec3::new(x, y, z);
                assert!((tangent.length() - 1.0).abs() < 1e-5 && tangent.dot(normal).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn a_texture_seam_is_two_vertices_with_one_normal() {
        let positions = vec![
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [1.0, 1.0, 0.0],
            [0.0, 0.0, 0.0],
            [1.0, 1.0, 0.0],
            [0.0, 1.0, 0.0],
        ];
        let surface = SurfaceMesh::new(positions, vec![[0, 1, 2], [3, 4, 5]], None, Vec::new()).unwrap();
        let topology = Topology::new(&surface, 0.5);
        assert_eq!(topology.source.len(), 6);
        assert_eq!(topology.normals, 4);
        assert_eq!(
            topology.normal[topology.triangles[0][0] as usize],
            topology.normal[topology.triangles[1][0] as usize]
        );
    }
}

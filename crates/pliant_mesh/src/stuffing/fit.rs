//! Fits a mesh to a shape: shrinks the mesh of an inflated shape onto the shape itself, and moves
//! boundary nodes to sharp edges.
//!
//! A lattice loses what is thinner than about a cell and cuts off sharp edges by up to a cell. The
//! mesh of the shape that is inflated by a part of a cell loses neither. Its boundary nodes are led
//! to the closest points of the shape, which lie on sharp edges where the inflated shape is round,
//! and the nodes inside follow. Then boundary nodes move to where the tangent planes at their
//! triangles' centers meet (the dual/primal optimization of Ohtake and Belyaev 2003, *Computer
//! Graphics Forum* 22(4)), so that triangles lie neither inside nor outside the surface on the
//! whole. No node moves where the angles of a tetrahedron would leave
//! [`FITTED_BOUNDS_DEG`](super::FITTED_BOUNDS_DEG), and nothing is added or removed, so the mesh
//! keeps its topology and its count.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use super::manifold::{Around, tets_around};
use crate::{TetMesh, sdf::SignedDistance, tets::signed_volume};

/// Sine of [`FITTED_BOUNDS_DEG`](super::FITTED_BOUNDS_DEG), 5 degrees.
const MIN_SINE: f64 = 0.087_155_742_747_658_17;
/// Number of equal parts of the way onto the surface.
const SHRINK_STEPS: usize = 12;
/// Number of rounds that follow, in which nodes move to edges and angles improve.
const POLISH_ROUNDS: usize = 16;
/// Largest number of rounds that adjust the volume, and the error that ends them.
const SETTLE_ROUNDS: usize = 8;
const SETTLED: f64 = 1e-6;
/// Sweeps that spread the displacement of the boundary over the nodes inside.
const SPREAD_SWEEPS: usize = 6;
/// Sine of the dihedral angles below which nodes move towards their neighbors' mean.
const POOR_SINE: f64 = 0.45;
/// Sine below which nodes also move along the axes, by these parts of the way to their nearest
/// neighbor.
const BAD_SINE: f64 = 0.3;
const AXIS_PARTS: [f64; 2] = [0.2, 0.05];
/// Weight that keeps a node where its tangent planes do not say where to go, as a fraction of
/// theirs.
const STAY: f64 = 0.02;

/// Moves the nodes of a mesh of an inflated shape onto the shape, which has this volume (m^3).
///
/// Returns the volume by which the mesh missed the shape, m^3: the larger of the error of its
/// volume and the volume between its boundary and the surface. What is left of the volume's error
/// is then divided over the whole surface.
pub(super) fn fit(mesh: &mut TetMesh, sdf: &dyn SignedDistance, volume: f64) -> f64 {
    let mut fit = Fit::new(mesh, sdf);
    for step in 0..SHRINK_STEPS {
        fit.shrink(1.0 / (SHRINK_STEPS - step) as f64);
        fit.improve();
    }
    for _ in 0..POLISH_ROUNDS {
        fit.meet_tangents();
        fit.improve();
    }
    let missed = (fit.volume() - volume).abs().max(fit.gap());
    fit.settle(volume);
    mesh.nodes = fit.nodes.iter().map(|&p| p.into()).collect();
    missed
}

struct Fit<'a> {
    sdf: &'a dyn SignedDistance,
    nodes: Vec<Vector3<f64>>,
    tets: &'a [[u32; 4]],
    /// Tetrahedra at each node.
    around: Around,
    /// Boundary triangles.
    faces: Vec<[u32; 3]>,
    /// Boundary triangles at each node, none for a node inside.
    faces_at: Vec<Vec<u32>>,
}

impl<'a> Fit<'a> {
    fn new(mesh: &'a TetMesh, sdf: &'a dyn SignedDistance) -> Self {
        let (surface, node_of) = mesh.boundary();
        let faces: Vec<[u32; 3]> = surface.triangles.iter().map(|t| t.map(|v| node_of[v as usize])).collect();
        let mut faces_at = vec![Vec::new(); mesh.nodes.len()];
        for (face, nodes) in (0..).zip(&faces) {
            for &n in nodes {
                faces_at[n as usize].push(face);
            }
        }
        Self {
            sdf,
            nodes: mesh.nodes.iter().map(|&p| p.into()).collect(),
            tets: &mesh.tets,
            around: tets_around(mesh),
            faces,
            faces_at,
        }
    }

    /// Leads boundary nodes this part of the way to the surface, and the nodes inside along.
    fn shrink(&mut self, part: f64) {
        let mut ways: Vec<Vector3<f64>> = (0..self.nodes.len())
            .into_par_iter()
            .map(|n| {
                if self.faces_at[n].is_empty() {
                    return Vector3::zeros();
                }
                let p = self.nodes[n];
                (Vector3::from(self.sdf.closest(p.into())) - p) * part
            })
            .collect();
        for _ in 0..SPREAD_SWEEPS {
            for n in 0..ways.len() {
                if self.faces_at[n].is_empty() {
                    ways[n] = self.mean_around(n, |m| ways[m]);
                }
            }
        }
        for (n, way) in ways.into_iter().enumerate() {
            self.go(n, self.nodes[n] + way);
        }
    }

    /// Moves the boundary out or in until the mesh has this volume, m^3, or no node can move.
    fn settle(&mut self, volume: f64) {
        for _ in 0..SETTLE_ROUNDS {
            let missing = volume - self.volume();
            if missing.abs() <= SETTLED * volume {
                break;
            }
            let area: f64 = (0..self.faces.len() as u32).map(|f| 0.5 * self.normal(f).norm()).sum();
            for n in 0..self.nodes.len() {
                let normal = self.normal_at(n);
                let length = normal.norm();
                if length > 0.0 {
                    self.go(n, self.nodes[n] + normal * (missing / (area * length)));
                }
            }
            self.improve();
        }
    }

    fn volume(&self) -> f64 {
        let at = |n: u32| self.nodes[n as usize];
        self.tets.iter().map(|&tet| signed_volume(tet.map(at))).sum()
    }

    /// Returns the volume between the boundary and the surface, m^3: the distance of each
    /// triangle's center times its area.
    fn gap(&self) -> f64 {
        let gaps: Vec<f64> = (0..self.faces.len() as u32)
            .into_par_iter()
            .map(|face| 0.5 * self.sdf.distance(self.center(face).into()).abs() * self.normal(face).norm())
            .collect();
        gaps.iter().sum()
    }

    /// Moves boundary nodes towards the point where the tangent planes of the surface at their
    /// triangles meet.
    fn meet_tangents(&mut self) {
        let planes: Vec<(Vector3<f64>, Vector3<f64>, f64)> = (0..self.faces.len() as u32)
            .into_par_iter()
            .map(|face| {
                let (center, normal) = (self.center(face), self.normal(face));
                let area = normal.norm();
                let on = Vector3::from(self.sdf.closest(center.into()));
                let away = center - on;
                // Where the triangle's center lies on the surface, so does the triangle.
                let normal =
                    if away.norm_squared() > 1e-16 * area { away.normalize() } else { normal / area };
                (on, normal, area)
            })
            .collect();
        for n in 0..self.nodes.len() {
            if self.faces_at[n].is_empty() {
                continue;
            }
            let at = self.nodes[n];
            let (mut matrix, mut right, mut weight) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
            for &face in &self.faces_at[n] {
                let (on, normal, area) = planes[face as usize];
                matrix += area * normal * normal.transpose();
                right += area * normal.dot(&(on - at)) * normal;
                weight += area;
            }
            matrix += Matrix3::identity() * (STAY * weight);
            if let Some(way) = matrix.cholesky().map(|m| m.solve(&right)) {
                self.go(n, at + way);
            }
        }
    }

    /// Moves nodes at poor tetrahedra where this improves the angles: towards the mean of their
    /// neighbors, else a little along an axis. Boundary nodes move along the boundary only.
    fn improve(&mut self) {
        for n in 0..self.nodes.len() {
            let before = self.star(n);
            if before >= POOR_SINE {
                continue;
            }
            let inside = self.faces_at[n].is_empty();
            let at = self.nodes[n];
            let mean = if inside { self.mean_around(n, |m| self.nodes[m]) } else { self.mean_beside(n) };
            let normal = self.normal_at(n);
            let squared = normal.norm_squared();
            let along = |way: Vector3<f64>| {
                if squared > 0.0 { way - normal * (normal.dot(&way) / squared) } else { way }
            };
            let mut best = (before, at);
            let way = along(mean - at);
            for part in [1.0, 0.5, 0.25] {
                self.nodes[n] = at + way * part;
                let star = self.star(n);
                if star > best.0 {
                    best = (star, self.nodes[n]);
                    break;
                }
            }
            if best.0 < BAD_SINE {
                // The pattern search of a derivative-free descent, with the distance to the nearest
                // neighbor as the unit.
                self.nodes[n] = at;
                let unit = self.nearest(n);
                for part in AXIS_PARTS {
                    for axis in 0..3 {
                        for sign in [-1.0, 1.0] {
                            let mut way = Vector3::zeros();
                            way[axis] = sign * part * unit;
                            let from = best.1;
                            self.nodes[n] = from + along(way);
                            let star = self.star(n);
                            if star > best.0 {
                                best = (star, self.nodes[n]);
                            }
                        }
                    }
                }
            }
            self.nodes[n] = best.1;
        }
    }

    /// Returns the distance from a node to its nearest neighbor.
    fn nearest(&self, n: usize) -> f64 {
        let mut least = f64::INFINITY;
        for &tet in self.around.of(n) {
            for m in self.tets[tet as usize].into_iter().map(|m| m as usize).filter(|&m| m != n) {
                least = least.min((self.nodes[m] - self.nodes[n]).norm_squared());
            }
        }
        least.sqrt()
    }

    /// Moves a node to a point, or as far towards it as angles allow.
    fn go(&mut self, n: usize, to: Vector3<f64>) {
        let at = self.nodes[n];
        for part in [1.0, 0.5, 0.25, 0.125] {
            self.nodes[n] = at + (to - at) * part;
            if self.star(n) >= MIN_SINE {
                return;
            }
        }
        self.nodes[n] = at;
    }

    fn center(&self, face: u32) -> Vector3<f64> {
        let [a, b, c] = self.faces[face as usize].map(|n| self.nodes[n as usize]);
        (a + b + c) / 3.0
    }

    /// Returns the outward normal of a boundary triangle, twice its area long.
    fn normal(&self, face: u32) -> Vector3<f64> {
        let [a, b, c] = self.faces[face as usize].map(|n| self.nodes[n as usize]);
        (b - a).cross(&(c - a))
    }

    /// Returns the sum of the normals of a node's boundary triangles, 0 for a node inside.
    fn normal_at(&self, n: usize) -> Vector3<f64> {
        self.faces_at[n].iter().map(|&face| self.normal(face)).sum()
    }

    /// Returns the smallest sine of the dihedral angles of the tetrahedra at a node.
    fn star(&self, n: usize) -> f64 {
        let mut least = f64::INFINITY;
        for &tet in self.around.of(n) {
            least = least.min(least_sine(self.tets[tet as usize].map(|n| self.nodes[n as usize])));
        }
        least
    }

    /// Returns the mean over the tetrahedra at a node of `of` at their other nodes.
    fn mean_around(&self, n: usize, of: impl Fn(usize) -> Vector3<f64>) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        let tets = self.around.of(n);
        for &tet in tets {
            for m in self.tets[tet as usize].into_iter().map(|m| m as usize).filter(|&m| m != n) {
                sum += of(m);
            }
        }
        sum / (3 * tets.len()).max(1) as f64
    }

    /// Returns the mean of a boundary node's neighbors on the boundary.
    fn mean_beside(&self, n: usize) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for &face in &self.faces_at[n] {
            for m in self.faces[face as usize].into_iter().map(|m| m as usize).filter(|&m| m != n) {
                sum += self.nodes[m];
            }
        }
        sum / (2 * self.faces_at[n].len()).max(1) as f64
    }
}

/// Returns the smallest sine of the six dihedral angles: 0 for a flat tetrahedron, negative for one
/// that is inside out.
///
/// No trigonometric function is called, so the result is the same on all machines.
fn least_sine([a, b, c, d]: [Vector3<f64>; 4]) -> f64 {
    let (ab, ac, ad, bc, bd) = (b - a, c - a, d - a, c - b, d - b);
    let six_volumes = ab.cross(&ac).dot(&ad);
    // Twice the areas of the faces opposite to a, b, c and d.
    let [fa, fb, fc, fd] =
        [bc.cross(&bd), ac.cross(&ad), ab.cross(&ad), ab.cross(&ac)].map(|f| f.norm_squared());
    // The squared sine at an edge is (6 V)^2 times its length squared over the squared double areas
    // of its two faces.
    let worst = [
        (ab.norm_squared(), fc * fd),
        (ac.norm_squared(), fb * fd),
        (ad.norm_squared(), fb * fc),
        (bc.norm_squared(), fa * fd),
        (bd.norm_squared(), fa * fc),
        ((d - c).norm_squared(), fa * fb),
    ]
    .into_iter()
    .map(|(length, areas)| length / areas)
    .fold(f64::INFINITY, f64::min);
    let sine = six_volumes * worst.sqrt();
    if sine.is_finite() { sine } else { f64::NEG_INFINITY }
}

//! Signed distance from a triangle surface.

use std::collections::HashMap;

use nalgebra::Vector3;

use super::{Extent, SignedDistance};
use crate::{
    MeshError, Repair, Surface,
    bvh::{Bvh, Feature},
};

/// Solid inside a closed triangle surface.
///
/// The magnitude of the distance is exact. For a single closed surface the sign comes from the
/// normal at the closest point and is exact. This is the face normal, or the angle-weighted mean of
/// the faces around the edge or vertex (Baerentzen and Aanaes 2005). For a surface of several parts
/// the sign comes from the winding number. The winding of a part inside others then decides its
/// effect: an inward part is a cavity, and an outward part has no effect.
#[derive(Debug)]
pub struct SurfaceDistance {
    bvh: Bvh,
    bounds: [[f64; 3]; 2],
    sign: Sign,
    /// Volume and area, if the surface is one sound solid.
    extent: Option<Extent>,
}

#[derive(Debug)]
enum Sign {
    /// Normals of each triangle's face, three edges and three corners, with arbitrary length.
    Normals(Vec<[Vector3<f64>; 7]>),
    Winding,
}

impl SurfaceDistance {
    /// Prepares a surface that [`Surface::closed`] accepts.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::closed`].
    pub fn new(surface: &Surface) -> Result<Self, MeshError> {
        let solid = surface.closed()?;
        let corners: Vec<[Vector3<f64>; 3]> = solid.corners().collect();
        let sign =
            if solid.part_count() == 1 { Sign::Normals(normals(&solid, &corners)) } else { Sign::Winding };
        let bvh = Bvh::new(&corners);
        let extent = extent(&solid, &bvh);
        Ok(Self { bvh, bounds: solid.bounds(), sign, extent })
    }

    /// Prepares a surface that [`Surface::repaired`] can repair and returns the list of repairs.
    ///
    /// A point is inside where the winding number is above 1/2.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::repaired`].
    pub fn repaired(surface: &Surface) -> Result<(Self, Repair), MeshError> {
        let (solid, repair) = surface.repaired()?;
        let corners: Vec<[Vector3<f64>; 3]> = solid.corners().collect();
        let bvh = Bvh::new(&corners);
        let extent = solid.closed().ok().and_then(|sound| extent(&sound, &bvh));
        Ok((Self { bvh, bounds: solid.bounds(), sign: Sign::Winding, extent }, repair))
    }

    /// Prepares a surface with [`SurfaceDistance::new`] if possible, otherwise with
    /// [`SurfaceDistance::repaired`].
    ///
    /// A valid surface keeps its exact sign. A defective surface is repaired, and the result lists
    /// the repairs. `None` means that no repair was necessary.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::check`] and, for a defective surface, those of
    /// [`Surface::repaired`]. A defective surface is refused only where winding numbers cannot
    /// decide what is inside.
    pub fn mended(surface: &Surface) -> Result<(Self, Option<Repair>), MeshError> {
        match Self::new(surface) {
            Ok(sound) => Ok((sound, None)),
            Err(
                MeshError::FlatTriangle { .. }
                | MeshError::Open { .. }
                | MeshError::NonManifoldEdge { .. }
                | MeshError::Orientation { .. }
                | MeshError::SelfCrossing { .. },
            ) => Self::repaired(surface).map(|(solid, repair)| (solid, Some(repair))),
            Err(other) => Err(other),
        }
    }

    /// Returns how often the surface winds around `p`: 1 inside, 0 outside.
    pub fn winding_number(&self, p: [f64; 3]) -> f64 {
        self.bvh.winding_number(p.into())
    }
}

impl SignedDistance for SurfaceDistance {
    fn distance(&self, p: [f64; 3]) -> f64 {
        let p = Vector3::from(p);
        let closest = self.bvh.closest(p);
        let inside = match &self.sign {
            Sign::Winding => self.bvh.winding_number(p) > 0.5,
            Sign::Normals(normals) => {
                let normal = normals[closest.triangle as usize][match closest.feature {
                    Feature::Face => 0,
                    Feature::Edge(i) => 1 + i,
                    Feature::Corner(i) => 4 + i,
                }];
                normal.dot(&(p - closest.point)) < 0.0
            }
        };
        if inside { -closest.distance } else { closest.distance }
    }

    fn bounds(&self) -> [[f64; 3]; 2] {
        self.bounds
    }

    fn closest(&self, p: [f64; 3]) -> [f64; 3] {
        self.bvh.closest(p.into()).point.into()
    }

    fn extent(&self) -> Option<Extent> {
        self.extent
    }
}

/// Returns the volume and area of a sound surface that is one solid, which may have cavities.
///
/// Several solids may lie in each other, where their volumes do not add up.
fn extent(solid: &Surface, bvh: &Bvh) -> Option<Extent> {
    let origin = solid.positions.first().copied().map_or_else(Vector3::zeros, Vector3::from);
    let mut parts: HashMap<u32, Part> = HashMap::new();
    for (corners, part) in solid.corners().zip(solid.parts()) {
        let [a, b, c] = corners;
        let part = parts.entry(part).or_insert(Part { volume: 0.0, doubled: 0.0, widest: corners });
        part.volume += (a - origin).cross(&(b - origin)).dot(&(c - origin)) / 6.0;
        let doubled = (b - a).cross(&(c - a)).norm();
        if doubled > part.doubled {
            (part.doubled, part.widest) = (doubled, corners);
        }
    }
    let solids = parts.values().filter(|part| part.volume > 0.0).count();
    let sound = parts.len() == 1 || (solids == 1 && parts.values().all(|part| part.bounds_solid(bvh)));
    sound.then(|| Extent { volume: solid.volume(), area: solid.area() })
}

/// Piece of a surface: the outside of a solid, or a cavity, which has a negative volume.
struct Part {
    volume: f64,
    /// Twice the area of the widest triangle, m^2, and its corners.
    doubled: f64,
    widest: [Vector3<f64>; 3],
}

impl Part {
    /// Returns whether the solid lies on the inner side of the widest triangle, and nothing on the
    /// other one. Pieces do not cross, so this says the same of all other triangles.
    fn bounds_solid(&self, bvh: &Bvh) -> bool {
        let [a, b, c] = self.widest;
        let off = (b - a).cross(&(c - a)) * (1e-6 / self.doubled.sqrt());
        let winding = |side: f64| bvh.winding_number((a + b + c) / 3.0 + off * side);
        (winding(-1.0) - 1.0).abs() < 0.25 && winding(1.0).abs() < 0.25
    }
}

fn normals(solid: &Surface, corners: &[[Vector3<f64>; 3]]) -> Vec<[Vector3<f64>; 7]> {
    let faces: Vec<Vector3<f64>> =
        corners.iter().map(|[a, b, c]| (b - a).cross(&(c - a)).normalize()).collect();
    let mut at_vertex = vec![Vector3::zeros(); solid.positions.len()];
    let mut at_edge: HashMap<[u32; 2], Vector3<f64>> = HashMap::new();
    let edge = |t: &[u32; 3], i: usize| {
        let (a, b) = (t[i], t[(i + 1) % 3]);
        [a.min(b), a.max(b)]
    };
    for ((t, c), face) in solid.triangles.iter().zip(corners).zip(&faces) {
        for i in 0..3 {
            let (u, v) = (c[(i + 1) % 3] - c[i], c[(i + 2) % 3] - c[i]);
            at_vertex[t[i] as usize] += u.angle(&v) * face;
            *at_edge.entry(edge(t, i)).or_insert_with(Vector3::zeros) += face;
        }
    }
    let all = solid.triangles.iter().zip(&faces).map(|(t, face)| {
        let edges: [Vector3<f64>; 3] =
            std::array::from_fn(|i| at_edge.get(&edge(t, i)).copied().unwrap_or_else(Vector3::zeros));
        let vertices = t.map(|v| at_vertex[v as usize]);
        [*face, edges[0], edges[1], edges[2], vertices[0], vertices[1], vertices[2]]
    });
    all.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    #[test]
    fn the_distance_from_a_cube_is_exact_in_all_its_regions() {
        let (cube, _) = shapes::cube(3, 2.0).unwrap().boundary();
        let sdf = SurfaceDistance::new(&cube).unwrap();
        for (p, distance) in [
            ([1.0, 1.0, 1.0], -1.0),
            ([1.0, 0.25, 0.9], -0.25),
            ([1.2, 3.0, 0.7], 1.0),
            ([1.2, 3.0, 4.0], 5.0_f64.sqrt()),
            ([-1.0, 3.0, 4.0], 6.0_f64.sqrt()),
            ([1.0, 2.0, 1.0], 0.0),
        ] {
            assert!((sdf.distance(p) - distance).abs() < 1e-14, "{p:?}: {}", sdf.distance(p));
        }
    }

    #[test]
    fn normals_and_winding_numbers_give_the_same_sign() {
        let (ball, _) = shapes::sphere(7, 1.0).unwrap().boundary();
        let sdf = SurfaceDistance::new(&ball).unwrap();
        for n in 0..2000 {
            let x = |a: f64| (f64::from(n) * a).fract() * 2.4 - 1.2;
            let p = [x(0.819_172_513), x(0.671_043_606), x(0.549_700_478)];
            assert_eq!(sdf.distance(p) < 0.0, sdf.winding_number(p) > 0.5, "{p:?}");
        }
    }

    #[test]
    fn a_ball_turned_inwards_is_a_hollow_and_one_turned_outwards_is_nothing() {
        let (outer, _) = shapes::sphere(6, 1.0).unwrap().boundary();
        for (inwards, distance) in [(true, 1.0), (false, -1.0)] {
            let (inner, _) = shapes::sphere(6, 0.4).unwrap().boundary();
            let mut both = outer.clone();
            let offset = both.positions.len() as u32;
            both.positions.extend(inner.positions);
            both.triangles.extend(inner.triangles.iter().map(|t| {
                let [a, b, c] = t.map(|v| v + offset);
                if inwards { [a, c, b] } else { [a, b, c] }
            }));
            let sdf = SurfaceDistance::new(&both).unwrap();
            // Of a hollow the volume is known, of a ball within a ball it is not.
            let right = |e: Extent| (e.volume / both.volume() - 1.0).abs() < 1e-12;
            assert_eq!(sdf.extent().map(right), inwards.then_some(true));
            assert_eq!(sdf.distance([0.0, 0.1, 0.0]).signum(), distance);
            assert!(sdf.distance([0.0, 0.7, 0.0]) < 0.0);
            assert!(sdf.distance([0.0, 1.7, 0.0]) > 0.0);
        }
    }
}

//! Repairs defective surfaces so that they bound a solid. Winding numbers decide what is inside.

use std::{
    collections::{BTreeMap, HashMap},
    fmt,
};

use nalgebra::Vector3;

use crate::{MeshError, Surface, bvh::Bvh, surface::Connected};

/// Distance, as a fraction of the size, within which vertices are merged.
const WELD: f64 = 1e-7;
/// Largest area of all hole covers, as a fraction of the surface's area. Larger openings are
/// missing parts rather than holes.
const MAX_COVERS: f64 = 0.1;
/// Maximum number of triangles that are sampled to decide whether a part lies inside the others.
const SAMPLES: usize = 100;
/// Largest fraction of the area that may bound nothing.
const MAX_UNDECIDED: f64 = 0.05;

/// Changes that [`Surface::repaired`] made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Repair {
    /// Number of vertices that were welded to others. This includes texture seams and the corners
    /// of STL files.
    pub welded_vertices: usize,
    /// Number of dropped triangles: those without area and second copies.
    pub dropped_triangles: usize,
    /// Number of triangles whose winding was reversed.
    pub turned_triangles: usize,
    /// Number of holes that were covered.
    pub covered_holes: usize,
}

impl fmt::Display for Repair {
    /// Lists the changes in words, for example `8 vertices welded, 1 hole covered`.
    ///
    /// Without any change the text says that triangles cross each other.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all = [
            (self.welded_vertices, "vertex", "vertices", "welded"),
            (self.dropped_triangles, "triangle", "triangles", "dropped"),
            (self.turned_triangles, "triangle", "triangles", "turned"),
            (self.covered_holes, "hole", "holes", "covered"),
        ];
        let mut comma = "";
        for (count, one, many, done) in all.into_iter().filter(|(count, ..)| *count > 0) {
            write!(f, "{comma}{count} {} {done}", if count == 1 { one } else { many })?;
            comma = ", ";
        }
        if comma.is_empty() {
            f.write_str("triangles that cross each other left, inside told by winding numbers")?;
        }
        Ok(())
    }
}

impl Surface {
    /// Repairs the surface so that it bounds a solid.
    ///
    /// The repair welds close vertices, drops copies and triangles without area, gives neighbors
    /// the same winding, turns parts that are inside out, and covers each hole from its rim to the
    /// rim's center. Triangles may still cross each other. A point is inside where the winding
    /// number (Jacobson et al. 2013) is above 1/2, so overlapping parts form one body.
    /// [`crate::sdf::SurfaceDistance::repaired`] uses this rule.
    ///
    /// # Errors
    /// Returns the errors of [`Surface::check`], [`MeshError::Empty`] if no triangle is left,
    /// [`MeshError::Open`] if the holes are larger than a tenth of the surface, and
    /// [`MeshError::Undecided`] if more than a twentieth of the surface bounds nothing.
    pub fn repaired(&self) -> Result<(Self, Repair), MeshError> {
        self.check()?;
        let mut repair = Repair::default();
        let mut surface = self.welded();
        repair.welded_vertices = self.positions.len().saturating_sub(surface.positions.len());
        surface.drop_useless();
        repair.dropped_triangles = self.triangles.len() - surface.triangles.len();
        if surface.triangles.is_empty() {
            return Err(MeshError::Empty { what: "triangle with an area" });
        }
        repair.turned_triangles = surface.wind_alike();
        let area = surface.area();
        let rims = surface.rims();
        repair.covered_holes = rims.len();
        let sound = surface.triangles.len();
        for rim in &rims {
            surface.cover(rim);
        }
        let covers = Self { triangles: surface.triangles[sound..].to_vec(), ..surface.clone() }.area();
        if covers > MAX_COVERS * area {
            let [from, to] = [rims[0][0], rims[0][1]].map(|v| surface.positions[v as usize]);
            return Err(MeshError::Open { edges: rims.iter().map(Vec::len).sum(), from, to });
        }
        repair.turned_triangles += surface.turn_outwards();
        let undecided = surface.undecided();
        if undecided > MAX_UNDECIDED {
            return Err(MeshError::Undecided { share: undecided });
        }
        Ok((surface, repair))
    }

    /// Merges vertices within [`WELD`] times the size of each other and drops unused vertices.
    fn welded(&self) -> Self {
        let [low, high] = self.bounds().map(Vector3::from);
        let reach = (high - low).norm() * WELD;
        let place = |p: [f64; 3]| {
            <[i64; 3]>::from(((Vector3::from(p) - low) / reach).map(|x| x.floor().clamp(-1e15, 1e15) as i64))
        };
        let mut at: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
        let mut vertex_of = vec![u32::MAX; self.positions.len()];
        let mut welded = Self::default();
        for t in &self.triangles {
            welded.triangles.push(t.map(|v| {
                if vertex_of[v as usize] == u32::MAX {
                    let p = self.positions[v as usize];
                    let [x, y, z] = place(p);
                    // The search includes the neighboring cells, because two close vertices may lie
                    // on either side of a cell border.
                    let near = (0..27)
                        .flat_map(|n| at.get(&[x + n % 3 - 1, y + n / 3 % 3 - 1, z + n / 9 - 1]))
                        .flatten();
                    let close = |&&w: &&u32| {
                        (Vector3::from(welded.positions[w as usize]) - Vector3::from(p)).norm() <= reach
                    };
                    vertex_of[v as usize] = near.filter(close).min().copied().unwrap_or_else(|| {
                        let new = welded.positions.len() as u32;
                        welded.positions.push(p);
                        at.entry([x, y, z]).or_default().push(new);
                        new
                    });
                }
                vertex_of[v as usize]
            }));
        }
        welded
    }

    /// Drops triangles without area, and all but the first of several triangles with the same
    /// corners.
    fn drop_useless(&mut self) {
        let mut seen = HashMap::new();
        let areas: Vec<bool> = self.corners().map(|c| crate::solid::has_area(&c)).collect();
        let mut index = 0;
        self.triangles.retain(|t| {
            let mut key = *t;
            key.sort_unstable();
            let new = seen.insert(key, ()).is_none();
            index += 1;
            new && areas[index - 1]
        });
    }

    /// Returns the triangles at each edge, with a flag for those that run along it from its lower
    /// vertex.
    fn edges(&self) -> BTreeMap<[u32; 2], Vec<(u32, bool)>> {
        let mut edges: BTreeMap<[u32; 2], Vec<(u32, bool)>> = BTreeMap::new();
        for (t, &[a, b, c]) in (0..).zip(&self.triangles) {
            for [from, to] in [[a, b], [b, c], [c, a]] {
                edges.entry([from.min(to), from.max(to)]).or_default().push((t, from < to));
            }
        }
        edges
    }

    /// Turns triangles until neighbors across an edge of two triangles agree, as few as possible in
    /// each piece. Returns the number of turned triangles.
    fn wind_alike(&mut self) -> usize {
        let mut neighbors = vec![Vec::new(); self.triangles.len()];
        for same in self.edges().values() {
            if let [(a, x), (b, y)] = same[..] {
                neighbors[a as usize].push((b as usize, x == y));
                neighbors[b as usize].push((a as usize, x == y));
            }
        }
        // Some(true) marks a triangle that is to be turned.
        let mut turn: Vec<Option<bool>> = vec![None; self.triangles.len()];
        for start in 0..self.triangles.len() {
            if turn[start].is_some() {
                continue;
            }
            turn[start] = Some(false);
            let mut piece = vec![start];
            let mut next = 0;
            while let Some(&t) = piece.get(next) {
                next += 1;
                for &(other, against) in &neighbors[t] {
                    if turn[other].is_none() {
                        turn[other] = turn[t].map(|turned| turned != against);
                        piece.push(other);
                    }
                }
            }
            let turned = piece.iter().filter(|&&t| turn[t] == Some(true)).count();
            if 2 * turned > piece.len() {
                for &t in &piece {
                    turn[t] = turn[t].map(|turned| !turned);
                }
            }
        }
        self.turn_where(|t, _| turn[t] == Some(true))
    }

    fn turn_where(&mut self, turn: impl Fn(usize, &[u32; 3]) -> bool) -> usize {
        let mut turned = 0;
        for (t, triangle) in self.triangles.iter_mut().enumerate() {
            if turn(t, triangle) {
                triangle.swap(1, 2);
                turned += 1;
            }
        }
        turned
    }

    /// Returns closed paths along the edges where more triangles run one way than the other,
    /// against the majority.
    fn rims(&self) -> Vec<Vec<u32>> {
        let mut next: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for ([low, high], same) in self.edges() {
            let up = same.iter().filter(|s| s.1).count();
            let down = same.len() - up;
            for _ in down..up {
                next.entry(high).or_default().push(low);
            }
            for _ in up..down {
                next.entry(low).or_default().push(high);
            }
        }
        let mut rims = Vec::new();
        // As many edges lead to a vertex as away from it, so every path returns to its start.
        while let Some((&start, _)) = next.first_key_value() {
            let mut way = vec![start];
            loop {
                let at = way[way.len() - 1];
                let Some(ends) = next.get_mut(&at) else { break };
                let to = ends.pop();
                if ends.is_empty() {
                    next.remove(&at);
                }
                let Some(to) = to else { break };
                // A path that meets itself has closed a rim.
                if let Some(first) = way.iter().position(|&v| v == to) {
                    rims.push(way.split_off(first));
                    if first == 0 {
                        break;
                    }
                }
                way.push(to);
            }
        }
        rims
    }

    /// Adds triangles from a rim to the center of its vertices.
    fn cover(&mut self, rim: &[u32]) {
        if let [a, b, c] = *rim {
            self.triangles.push([a, b, c]);
            return;
        }
        let middle = rim.iter().map(|&v| Vector3::from(self.positions[v as usize])).sum::<Vector3<f64>>();
        let new = self.positions.len() as u32;
        self.positions.push((middle / rim.len() as f64).into());
        self.triangles.extend(rim.iter().zip(rim.iter().cycle().skip(1)).map(|(&a, &b)| [a, b, new]));
    }

    /// Turns parts of negative volume that lie inside no other part. A cavity may face inward, but
    /// a body may not.
    fn turn_outwards(&mut self) -> usize {
        let mut parts = Connected::new(self.positions.len());
        for t in &self.triangles {
            parts.join(t[0], t[1]);
            parts.join(t[0], t[2]);
        }
        let part: Vec<u32> = self.triangles.iter().map(|t| parts.of(t[0])).collect();
        let mut volumes: BTreeMap<u32, f64> = BTreeMap::new();
        for (&part, [a, b, c]) in part.iter().zip(self.corners()) {
            *volumes.entry(part).or_default() += a.cross(&b).dot(&c) / 6.0;
        }
        let all = Bvh::new(&self.corners().collect::<Vec<_>>());
        let of = |wanted: u32| -> Vec<[Vector3<f64>; 3]> {
            self.corners().zip(&part).filter(|(_, p)| **p == wanted).map(|(c, _)| c).collect()
        };
        let wrong: Vec<u32> = volumes
            .iter()
            .filter(|(part, volume)| {
                let inside_another = || {
                    let own = of(**part);
                    let alone = Bvh::new(&own);
                    // On its own triangles the part itself adds or removes one half, so its
                    // contribution is subtracted.
                    let inside = |[a, b, c]: &[Vector3<f64>; 3]| {
                        let p = (a + b + c) / 3.0;
                        (all.winding_number(p) - alone.winding_number(p)).abs() > 0.5
                    };
                    own.iter().step_by(own.len().div_ceil(SAMPLES)).all(inside)
                };
                **volume < 0.0 && (volumes.len() == 1 || !inside_another())
            })
            .map(|(part, _)| *part)
            .collect();
        self.turn_where(|t, _| wrong.contains(&part[t]))
    }

    /// Returns the fraction of the area that has no inside on either side.
    fn undecided(&self) -> f64 {
        let corners: Vec<[Vector3<f64>; 3]> = self.corners().collect();
        let bvh = Bvh::new(&corners);
        let (mut undecided, mut all) = (0.0, 0.0);
        for [a, b, c] in &corners {
            let vector = 0.5 * (b - a).cross(&(c - a));
            let area = vector.norm();
            let aside = vector / area * (1e-3 * area.sqrt());
            let middle = (a + b + c) / 3.0;
            all += area;
            if bvh.winding_number(middle - aside) < 0.5 && bvh.winding_number(middle + aside) < 0.5 {
                undecided += area;
            }
        }
        undecided / all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        StuffOptions,
        sdf::{SignedDistance, SurfaceDistance},
        shapes, stuff,
    };

    fn ball(radius: f64, at: f64) -> Surface {
        let (mut ball, _) = shapes::sphere(8, radius).unwrap().boundary();
        for p in &mut ball.positions {
            p[0] += at;
        }
        ball
    }

    fn both(mut a: Surface, b: &Surface) -> Surface {
        let offset = a.positions.len() as u32;
        a.positions.extend(&b.positions);
        a.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + offset)));
        a
    }

    #[test]
    fn a_sound_surface_stays_as_it_is() {
        let ball = ball(1.0, 0.0);
        let (same, repair) = ball.repaired().unwrap();
        assert_eq!(repair, Repair::default());
        assert!((same.volume() - ball.volume()).abs() < 1e-12);
    }

    #[test]
    fn holes_flips_copies_and_loose_corners_are_mended() {
        let sound = ball(1.0, 0.0);
        // Every triangle gets its own corners, which are slightly displaced.
        let mut dirty = Surface {
            positions: sound.triangles.iter().flatten().map(|&v| sound.positions[v as usize]).collect(),
            triangles: (0..sound.triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            uvs: None,
        };
        for (n, p) in dirty.positions.iter_mut().enumerate() {
            p[n % 3] += 1e-9 * (n % 7) as f64;
        }
        for t in (0..dirty.triangles.len()).step_by(5) {
            dirty.triangles[t].swap(0, 1);
        }
        dirty.triangles.push(dirty.triangles[50]);
        dirty.triangles.push([4, 4, 9]);
        for hole in [300, 200, 20] {
            dirty.triangles.remove(hole);
        }
        assert!(dirty.closed().is_err());
        let (mended, repair) = dirty.repaired().unwrap();
        assert_eq!(repair.welded_vertices, dirty.positions.len() - sound.positions.len());
        assert_eq!(repair.dropped_triangles, 2);
        assert_eq!(repair.covered_holes, 3);
        assert!((mended.volume() / sound.volume() - 1.0).abs() < 1e-6, "{}", mended.volume());
        mended.closed().unwrap();
    }

    #[test]
    fn a_larger_hole_is_covered_and_a_missing_half_is_refused() {
        let part = |above: f64| {
            let mut part = ball(1.0, 0.0);
            let positions = part.positions.clone();
            part.triangles.retain(|t| t.iter().all(|&v| positions[v as usize][1] < above));
            part.repaired()
        };
        let (covered, repair) = part(0.9).unwrap();
        assert_eq!(repair.covered_holes, 1);
        covered.closed().unwrap();
        assert!(matches!(part(0.0), Err(MeshError::Open { .. })));
    }

    #[test]
    fn overlapping_parts_are_one_body_even_if_one_is_inside_out() {
        for inside_out in [false, true] {
            let mut second = ball(0.7, 0.9);
            if inside_out {
                second.triangles.iter_mut().for_each(|t| t.swap(0, 1));
            }
            let sdf = SurfaceDistance::repaired(&both(ball(1.0, 0.0), &second)).unwrap().0;
            for (x, inside) in [(-0.9, true), (0.5, true), (1.5, true), (1.7, false), (-1.1, false)] {
                assert_eq!(sdf.distance([x, 0.01, 0.02]) < 0.0, inside, "{x} {inside_out}");
            }
            let mesh = stuff(&sdf, &StuffOptions::with_target(4000), &mut |_| ()).unwrap();
            // The reference volume is that of two balls minus the two caps of their intersection (h
            // from the plane of the common circle).
            let cap = |r: f64, h: f64| std::f64::consts::PI * h * h * (r - h / 3.0);
            let plane = (1.0 + 0.81 - 0.49) / 1.8;
            let ball = |r: f64| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
            let union = ball(1.0) + ball(0.7) - cap(1.0, 1.0 - plane) - cap(0.7, 0.7 - (0.9 - plane));
            assert!((mesh.volume() / union - 1.0).abs() < 0.03, "{} {union}", mesh.volume());
        }
    }

    #[test]
    fn a_hollow_stays_a_hollow() {
        let mut hollow = ball(0.4, 0.1);
        hollow.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let sdf = SurfaceDistance::repaired(&both(ball(1.0, 0.0), &hollow)).unwrap().0;
        assert!(sdf.distance([0.1, 0.0, 0.0]) > 0.0);
        assert!(sdf.distance([0.8, 0.0, 0.0]) < 0.0);
    }

    #[test]
    fn a_sheet_that_bounds_nothing_is_refused() {
        let positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let sheet = Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]], uvs: None };
        assert!(matches!(sheet.repaired(), Err(MeshError::Open { .. })));
        // A doubled sheet has no hole and no inside.
        let mut doubled = sheet.clone();
        doubled.triangles.extend([[1, 0, 3], [1, 3, 2]]);
        assert!(matches!(doubled.repaired(), Err(MeshError::Undecided { .. } | MeshError::Open { .. })));
    }
}

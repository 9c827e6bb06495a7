//! Body-centered cubic lattice around a shape: signs at its points, cut points on its edges, and
//! the warp.
//!
//! Lattice points have integer coordinates that are all even (corners of cells) or all odd
//! (centers). One unit is half a cell. A *long* edge joins two points of one kind, two units apart
//! along an axis. A *short* edge joins a corner and a center, one unit apart along every axis. Only
//! blocks of cells that the shape reaches are stored.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::{MeshError, sdf::SignedDistance};

/// Number of cells along the edge of a block.
const BLOCK: i32 = 8;
/// Number of points of a block: a corner and a center for each cell.
const POINTS: usize = 2 * (BLOCK * BLOCK * BLOCK) as usize;
/// Largest number of edges that a point owns: three long ones and, for a center, eight short ones.
const EDGES: usize = 11;
/// Largest number of block slots in the box around the shape. A thin shape in a wide box can need
/// more.
const MAX_PLACES: i64 = 1 << 25;
/// Largest number of stored blocks, 1.5e8 tetrahedra.
const MAX_BLOCKS: usize = 25_000;

/// Fraction of its edge within which a cut point moves the lattice point onto itself (Labelle and
/// Shewchuk 2007).
///
/// Over all stencils, cuts and displacements, wild fields included, the fractions for long and
/// short edges give the best smallest angle, 9.32 degrees, and at most 161.65 degrees. Surfaces
/// that the lattice resolves stay between 13 and 156 degrees.
const ALPHA_LONG: f64 = 0.24999;
const ALPHA_SHORT: f64 = 0.41189;

/// Tolerance for roots on edges, as a fraction of a cell.
const ROOT_TOLERANCE: f64 = 1e-8;

/// Integer coordinates of a lattice point.
pub(super) type Point = [i32; 3];

/// Position of a lattice point relative to the surface after the warp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LatticeSide {
    Inside,
    Outside,
    On,
}

struct Block {
    /// Coordinates of the first corner, in cells.
    cell: Point,
    sides: Vec<LatticeSide>,
    /// Positions of warped points, by point index.
    warped: Vec<(u32, Vector3<f64>)>,
    /// Cut points of owned edges, sorted by the key `point * EDGES + edge`.
    cuts: Vec<(u32, Vector3<f64>)>,
}

/// Lattice around a shape, as the module documentation describes.
pub(super) struct Lattice<'a> {
    sdf: &'a dyn SignedDistance,
    /// Length of a long edge, m.
    cell: f64,
    /// Position of point (0, 0, 0), m.
    origin: Vector3<f64>,
    /// Number of block slots along each axis. The first slot contains point (0, 0, 0).
    places: Point,
    /// Index of the block in each slot, or `u32::MAX` for none.
    block_at: Vec<u32>,
    blocks: Vec<Block>,
}

impl<'a> Lattice<'a> {
    /// Makes the warped lattice with cells of `cell` meters, with signs and cut points.
    ///
    /// A corner of a cell lies at the center of the shape's box, moved by `shift` cells.
    pub(super) fn new(sdf: &'a dyn SignedDistance, cell: f64, shift: [f64; 3]) -> Result<Self, MeshError> {
        let [low, high] = sdf.bounds().map(Vector3::from);
        // The number of cells on each side of the box's center is an integer, so that a symmetric
        // shape meets a symmetric lattice. Two more cells around the box are certainly outside.
        let half = ((high - low) / (2.0 * cell)).map(|n| n.ceil() + 2.0);
        let places = half.map(|n| (2.0 * n / f64::from(BLOCK)).ceil());
        if places.product() > MAX_PLACES as f64 {
            return Err(MeshError::parameter(
                "number of tetrahedra",
                "fewer of them, or a shape that fills more of its box",
                format!("cells of {cell:e} m in a box of {:?} m", <[f64; 3]>::from(high - low)),
            ));
        }
        let places: Point = places.map(|n| n as i32).into();
        let mut lattice = Self {
            sdf,
            cell,
            origin: (low + high) / 2.0 + (Vector3::from(shift) - half) * cell,
            places,
            block_at: vec![u32::MAX; places.iter().map(|&n| n as usize).product()],
            blocks: Vec::new(),
        };
        let cells = lattice.reached_blocks()?;
        let distances: Vec<Vec<f64>> = cells.par_iter().map(|&cell| lattice.distances(cell)).collect();
        let surface: Vec<bool> = distances.iter().map(|d| d.iter().any(|d| d.is_finite())).collect();
        for (cell, distances) in cells.into_iter().zip(&distances) {
            let place = lattice.place(cell.map(|c| 2 * c));
            if let Some(slot) = place {
                lattice.block_at[slot] = lattice.blocks.len() as u32;
            }
            let sides = distances.iter().map(|&d| side(d)).collect();
            lattice.blocks.push(Block { cell, sides, warped: Vec::new(), cuts: Vec::new() });
        }
        let cuts: Vec<_> = (0..lattice.blocks.len())
            .into_par_iter()
            .map(|block| if surface[block] { lattice.cut_edges(block, &distances) } else { Vec::new() })
            .collect();
        for (block, cuts) in lattice.blocks.iter_mut().zip(cuts) {
            block.cuts = cuts;
        }
        for block in (0..lattice.blocks.len()).filter(|&b| surface[b]) {
            lattice.warp(block);
        }
        Ok(lattice)
    }

    /// Returns the first cells of all blocks with a point inside or next to the surface, in a fixed
    /// order.
    ///
    /// Whole octants are skipped by their distance to the surface.
    fn reached_blocks(&self) -> Result<Vec<Point>, MeshError> {
        let largest = self.places.iter().copied().max().unwrap_or(1).max(1) as u32;
        let mut stack = vec![([0; 3], largest.next_power_of_two() as i32)];
        let mut found = Vec::new();
        while let Some((at, size)) = stack.pop() {
            if (0..3).any(|a| at[a] >= self.places[a]) {
                continue;
            }
            let sure = self.sure_side(at.map(|p| 2 * BLOCK * p), 2 * BLOCK * size);
            if sure == Some(LatticeSide::Outside) {
                continue;
            }
            if size == 1 {
                if found.len() == MAX_BLOCKS {
                    return Err(MeshError::parameter(
                        "number of tetrahedra",
                        "at most 100 million",
                        format!("cells of {:e} m", self.cell),
                    ));
                }
                found.push(at.map(|p| BLOCK * p));
                continue;
            }
            let half = size / 2;
            for octant in (0..8).rev() {
                stack.push((std::array::from_fn(|a| at[a] + half * (octant >> a & 1)), half));
            }
        }
        Ok(found)
    }

    /// Returns the common side of all points from `first` over `extent` units along each axis.
    ///
    /// Returns `None` if the distance at the center does not decide the side for the points and
    /// their neighbors.
    fn sure_side(&self, first: Point, extent: i32) -> Option<LatticeSide> {
        let middle = self.rest_position(first) + Vector3::repeat(f64::from(extent - 1) * self.cell / 4.0);
        // The reach goes from the center to the farthest point, plus one long edge.
        let reach = self.cell * (3_f64.sqrt() * f64::from(extent - 1) / 4.0 + 1.0);
        let distance = self.sdf.distance(middle.into());
        if distance > reach {
            Some(LatticeSide::Outside)
        } else if distance < -reach {
            Some(LatticeSide::Inside)
        } else {
            None
        }
    }

    /// Returns the distances of a block's points. They are infinite where only the side is known.
    fn distances(&self, cell: Point) -> Vec<f64> {
        let mut distances = vec![f64::INFINITY; POINTS];
        let mut stack = vec![([0; 3], BLOCK)];
        while let Some((at, size)) = stack.pop() {
            let first: Point = std::array::from_fn(|a| 2 * (cell[a] + at[a]));
            let sure = self.sure_side(first, 2 * size);
            if sure.is_none() && size > 1 {
                let half = size / 2;
                for octant in 0..8 {
                    stack.push((std::array::from_fn(|a| at[a] + half * (octant >> a & 1)), half));
                }
                continue;
            }
            for i in at[0]..at[0] + size {
                for j in at[1]..at[1] + size {
                    for k in at[2]..at[2] + size {
                        for center in 0..2 {
                            let point: Point = std::array::from_fn(|a| 2 * (cell[a] + [i, j, k][a]) + center);
                            distances[local(point)] = match sure {
                                Some(LatticeSide::Inside) => f64::NEG_INFINITY,
                                Some(_) => f64::INFINITY,
                                None => self.sdf.distance(self.rest_position(point).into()),
                            };
                        }
                    }
                }
            }
        }
        distances
    }

    /// Returns the cut points of the edges that a block's points own.
    fn cut_edges(&self, block: usize, distances: &[Vec<f64>]) -> Vec<(u32, Vector3<f64>)> {
        let mut cuts = Vec::new();
        let distance = |p: Point| self.block_of(p).map_or(f64::INFINITY, |block| distances[block][local(p)]);
        for index in 0..POINTS {
            let point = self.point(block, index);
            for (edge, step) in owned_edges(point).iter().enumerate() {
                let other = add(point, *step);
                let ends = [self.side(point), self.side(other)];
                if matches!(
                    ends,
                    [LatticeSide::Inside, LatticeSide::Outside] | [LatticeSide::Outside, LatticeSide::Inside]
                ) {
                    cuts.push((
                        (index * EDGES + edge) as u32,
                        self.root([point, other], [distance(point), distance(other)]),
                    ));
                }
            }
        }
        cuts
    }

    /// Returns the point where the surface crosses the edge between two points with these
    /// distances.
    ///
    /// The method is false position in the Illinois form, which keeps the bracket.
    fn root(&self, ends: [Point; 2], [mut f0, mut f1]: [f64; 2]) -> Vector3<f64> {
        let [a, b] = ends.map(|p| self.rest_position(p));
        let value = |t: f64| self.sdf.distance((a + (b - a) * t).into());
        let (mut t0, mut t1) = (0.0, 1.0);
        let mut t = 0.5;
        for _ in 0..60 {
            let secant = (t0 * f1 - t1 * f0) / (f1 - f0);
            // The bracket is halved where the field jumps or is not finite.
            t = if secant > t0 && secant < t1 { secant } else { 0.5 * (t0 + t1) };
            let f = value(t);
            if f.abs() <= ROOT_TOLERANCE * self.cell || t1 - t0 <= ROOT_TOLERANCE {
                break;
            }
            if (f < 0.0) == (f0 < 0.0) {
                (t0, f0) = (t, f);
                f1 *= 0.5;
            } else {
                (t1, f1) = (t, f);
                f0 *= 0.5;
            }
        }
        a + (b - a) * t
    }

    /// Moves each point of a block onto its closest cut point, if this cut point is too close.
    ///
    /// The move removes the cut points on the edges of the moved point. The result is
    /// deterministic, because the order of points is fixed.
    fn warp(&mut self, block: usize) {
        for index in 0..POINTS {
            let point = self.point(block, index);
            if self.side(point) == LatticeSide::On {
                continue;
            }
            let rest = self.rest_position(point);
            let mut closest: Option<(f64, Vector3<f64>)> = None;
            for step in &STEPS {
                let other = add(point, *step);
                let Some(cut) = self.cut(point, other) else { continue };
                let (alpha, length) = if is_long(*step) {
                    (ALPHA_LONG, self.cell)
                } else {
                    (ALPHA_SHORT, self.cell * 0.75_f64.sqrt())
                };
                let distance = (cut - rest).norm();
                if distance < alpha * length && closest.is_none_or(|(d, _)| distance < d) {
                    closest = Some((distance, cut));
                }
            }
            if let Some((_, position)) = closest {
                self.blocks[block].sides[index] = LatticeSide::On;
                self.blocks[block].warped.push((index as u32, position));
            }
        }
    }

    /// Returns the cut point between two neighbors, or `None` if the warp has moved an end.
    pub(super) fn cut(&self, a: Point, b: Point) -> Option<Vector3<f64>> {
        let sides = [self.side(a), self.side(b)];
        if !matches!(
            sides,
            [LatticeSide::Inside, LatticeSide::Outside] | [LatticeSide::Outside, LatticeSide::Inside]
        ) {
            return None;
        }
        let (block, key) = self.cut_key(a, b)?;
        let cuts = &self.blocks[block].cuts;
        cuts.binary_search_by_key(&key, |c| c.0).ok().map(|i| cuts[i].1)
    }

    /// Returns the block and the key of an edge. The lower end owns a long edge, and the center
    /// owns a short edge.
    fn cut_key(&self, a: Point, b: Point) -> Option<(usize, u32)> {
        let step = sub(b, a);
        let forward = if is_long(step) { step.iter().sum::<i32>() > 0 } else { a[0] & 1 == 1 };
        let (owner, step) = if forward { (a, step) } else { (b, sub(a, b)) };
        let edge = owned_edges(owner).iter().position(|&s| s == step)?;
        Some((self.block_of(owner)?, (local(owner) * EDGES + edge) as u32))
    }

    /// Returns a key that identifies a lattice point as a node of the mesh. `edge_key` does
    /// so for an edge.
    pub(super) fn point_key(&self, point: Point) -> Option<u64> {
        Some((self.block_of(point)? * POINTS + local(point)) as u64)
    }

    pub(super) fn edge_key(&self, a: Point, b: Point) -> Option<u64> {
        let (block, key) = self.cut_key(a, b)?;
        Some(((self.blocks.len() + block * EDGES) * POINTS) as u64 + u64::from(key))
    }

    /// Returns the position of a point after the warp.
    pub(super) fn position(&self, point: Point) -> Vector3<f64> {
        let warped = self.block_of(point).and_then(|block| {
            let warped = &self.blocks[block].warped;
            warped.binary_search_by_key(&(local(point) as u32), |w| w.0).ok().map(|i| warped[i].1)
        });
        warped.unwrap_or_else(|| self.rest_position(point))
    }

    pub(super) fn side(&self, point: Point) -> LatticeSide {
        self.block_of(point).map_or(LatticeSide::Outside, |block| self.blocks[block].sides[local(point)])
    }

    /// Visits all tetrahedra of the lattice with a corner inside, in a fixed order.
    ///
    /// Four tetrahedra surround each long edge between two centers (the first two corners). A long
    /// edge between two corners closes each of them.
    pub(super) fn for_each_tet(&self, mut visit: impl FnMut([Point; 4])) {
        for block in &self.blocks {
            // If the block of a tetrahedron's first center is not stored, the tetrahedron is
            // outside, because the block and all neighboring points are outside.
            for cell in 0..BLOCK * BLOCK * BLOCK {
                let ijk = [cell / (BLOCK * BLOCK), cell / BLOCK % BLOCK, cell % BLOCK];
                let center: Point = std::array::from_fn(|a| 2 * (block.cell[a] + ijk[a]) + 1);
                for axis in 0..3 {
                    let next = add(center, long(axis, 2));
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    let ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)].map(|(du, dv)| {
                        let mut corner = center;
                        corner[axis] += 1;
                        corner[u] += du;
                        corner[v] += dv;
                        corner
                    });
                    for i in 0..4 {
                        let tet = [center, next, ring[i], ring[(i + 1) % 4]];
                        if tet.iter().any(|&p| self.side(p) == LatticeSide::Inside) {
                            visit(tet);
                        }
                    }
                }
            }
        }
    }

    fn rest_position(&self, point: Point) -> Vector3<f64> {
        self.origin + Vector3::from(point.map(f64::from)) * (self.cell / 2.0)
    }

    fn place(&self, point: Point) -> Option<usize> {
        let place = point.map(|x| x.div_euclid(2 * BLOCK));
        (0..3)
            .all(|a| (0..self.places[a]).contains(&place[a]))
            .then(|| ((place[0] * self.places[1] + place[1]) * self.places[2] + place[2]) as usize)
    }

    fn block_of(&self, point: Point) -> Option<usize> {
        let block = self.block_at[self.place(point)?];
        (block != u32::MAX).then_some(block as usize)
    }

    fn point(&self, block: usize, index: usize) -> Point {
        let (cell, center) = ((index / 2) as i32, (index % 2) as i32);
        let ijk = [cell / (BLOCK * BLOCK), cell / BLOCK % BLOCK, cell % BLOCK];
        std::array::from_fn(|a| 2 * (self.blocks[block].cell[a] + ijk[a]) + center)
    }
}

/// Returns the side for a distance. NaN counts as outside.
fn side(distance: f64) -> LatticeSide {
    if distance < 0.0 {
        LatticeSide::Inside
    } else if distance == 0.0 {
        LatticeSide::On
    } else {
        LatticeSide::Outside
    }
}

/// Returns the index of a point within its block.
fn local(point: Point) -> usize {
    let [i, j, k] = point.map(|x| x.div_euclid(2).rem_euclid(BLOCK));
    (2 * ((i * BLOCK + j) * BLOCK + k) + (point[0] & 1)) as usize
}

const LONG: [Point; 6] = [[2, 0, 0], [0, 2, 0], [0, 0, 2], [-2, 0, 0], [0, -2, 0], [0, 0, -2]];
/// Steps to the neighbors of a point. The owned edges come first.
const STEPS: [Point; 14] = [
    LONG[0],
    LONG[1],
    LONG[2],
    [-1, -1, -1],
    [-1, -1, 1],
    [-1, 1, -1],
    [-1, 1, 1],
    [1, -1, -1],
    [1, -1, 1],
    [1, 1, -1],
    [1, 1, 1],
    LONG[3],
    LONG[4],
    LONG[5],
];

fn owned_edges(point: Point) -> &'static [Point] {
    if point[0] & 1 == 1 { &STEPS[..EDGES] } else { &STEPS[..3] }
}

fn long(axis: usize, length: i32) -> Point {
    let mut step = [0; 3];
    step[axis] = length;
    step
}

pub(super) fn is_long(step: Point) -> bool {
    step.contains(&0)
}

fn add(a: Point, b: Point) -> Point {
    std::array::from_fn(|i| a[i] + b[i])
}

pub(super) fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|i| a[i] - b[i])
}

//! The solver: the laws of all contacts of a group of bodies together.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use super::{Near, Spot, point::ContactPoint};
use crate::{simd::dot, step::Frame};

mod direct;

/// The coordinates of one body in the vector of all: its modes and six for its frame.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Span {
    pub(crate) start: usize,
    pub(crate) width: usize,
    /// End of the coordinates with which those of the body are coupled by contacts.
    reach: usize,
}

/// One side of a point: the body, and where its three rows begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Side {
    pub(crate) member: usize,
    pub(crate) rows: usize,
}

/// How far the sites of one body are away from another body at least, so that most of them need not
/// be looked at.
#[derive(Debug, Clone, Default)]
pub(crate) struct Clearance {
    /// Keys of both bodies.
    pair: [u64; 2],
    used: bool,
    /// The frames at which the distances hold, and how far the sites of both had gone, m.
    pub(crate) frames: [Frame; 2],
    pub(crate) ways: [f64; 2],
    /// Distance of each site at least, m. Empty if none is known.
    pub(crate) sites: Vec<f64>,
}

/// A look for contacts of the sites of one body with another body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Look {
    pub(crate) members: [usize; 2],
}

/// Workspace of the contacts of a group of bodies in a step.
#[derive(Debug, Clone, Default)]
pub(crate) struct Touching {
    pub(crate) points: Vec<ContactPoint>,
    /// One span per body, probe and rigid body, and which of them belong to probes.
    pub(crate) spans: Vec<Span>,
    probes: Range<usize>,
    /// The sides of each point. Each has three rows of one entry per coordinate of its body, such
    /// that the response of point `i` to forces at point `j` is the sum of `rows_i rows_j^T` over
    /// the bodies of both.
    pub(crate) sides: Vec<[Option<Side>; 2]>,
    pub(crate) rows: Vec<f64>,
    /// What the hands hold back of the responses, one row for each of their directions.
    pub(crate) held: Vec<f64>,
    /// Sum of `rows^T` times the changes of the forces.
    sum: Vec<f64>,
    /// The matrix of the direct solve by rows, its right side, and the unknowns of each point.
    full: Vec<f64>,
    right: Vec<f64>,
    unknowns: Vec<Span>,
    /// Coordinates of Newton's method, those before its step, and what is off balance there.
    z: Vec<f64>,
    before: Vec<f64>,
    off_balance: Vec<f64>,
    /// Responses of all points to forces at all points, by rows, where they are few.
    responses: Vec<f64>,
    /// Marks of the sites that have a point with the current obstacle or body.
    pub(crate) marks: Vec<u32>,
    pub(crate) stamp: u32,
    pub(crate) sweeps: usize,
    /// Clearances of pairs, sorted by their keys, and unused ones.
    pub(crate) clear: Vec<Clearance>,
    spare: Vec<Clearance>,
    pub(crate) looks: Vec<Look>,
    /// Forces of the supports of all rigid bodies at the beginning of the step, N.
    pub(crate) supports: Vec<f64>,
    /// The points whose sites belong to the other body of the current look, with force: where they
    /// touch, m.
    pub(crate) covered: Vec<Vector3<f64>>,
    /// Places between the corners of a probe that penetrate the present body, and whether they have
    /// passed through its surface.
    pub(crate) between: Vec<(Near, bool, Spot)>,
    /// Site and bodies of each point, the second [`usize::MAX`] at an obstacle.
    pub(crate) heads: Vec<[usize; 3]>,
}

impl Touching {
    /// Largest number of direct solves, and of sweeps before each.
    const TURNS: usize = 12;
    const SWEEPS: usize = 3;

    /// Largest number of steps of Newton's method.
    const DESCENTS: usize = 24;

    /// Largest number of tangents of a dent in one solve.
    const TANGENTS: usize = 4;

    /// Largest number of coordinates, and of multiplications, of a direct solve.
    const MAX_WIDTH: usize = 512;
    const MAX_WORK: usize = 4_000_000;

    /// Largest violation of the laws at the end of the last computed step, m.
    pub(crate) fn violation(&self) -> f64 {
        self.points.iter().map(ContactPoint::violation).fold(0.0, f64::max)
    }

    /// Reserves memory for a number of points and sites of a body alone.
    pub(crate) fn reserve(&mut self, points: usize, width: usize, sites: usize) {
        fn reserve<T>(list: &mut Vec<T>, count: usize) {
            list.reserve(count.saturating_sub(list.len()));
        }
        reserve(&mut self.points, points);
        reserve(&mut self.sides, points);
        reserve(&mut self.heads, points);
        reserve(&mut self.rows, 3 * points * width);
        reserve(&mut self.spans, 1);
        reserve(&mut self.sum, width);
        for list in [&mut self.right, &mut self.z, &mut self.before, &mut self.off_balance] {
            reserve(list, width);
        }
        reserve(&mut self.full, width * width);
        reserve(&mut self.unknowns, points);
        reserve(&mut self.responses, width * width);
        reserve(&mut self.marks, sites);
    }

    /// Begins a step of all islands: forgets the clearances of pairs that were not near each other
    /// in the step before.
    pub(crate) fn begin_step(&mut self) {
        let mut index = 0;
        while index < self.clear.len() {
            if std::mem::take(&mut self.clear[index].used) {
                index += 1;
            } else {
                let mut unused = self.clear.remove(index);
                unused.sites.clear();
                self.spare.push(unused);
            }
        }
    }

    /// The clearances of the sites of the first body from the second, as an index. `pair` has the
    /// keys of both.
    pub(crate) fn clearance(&mut self, pair: [u64; 2]) -> usize {
        let index = match self.clear.binary_search_by_key(&pair, |clear| clear.pair) {
            Ok(index) => index,
            Err(index) => {
                let fresh = self.spare.pop().unwrap_or_default();
                self.clear.insert(index, Clearance { pair, ..fresh });
                index
            }
        };
        self.clear[index].used = true;
        index
    }

    /// Lays out the coordinates of all bodies. `widths` has the number of each, and `probes` are
    /// those of them that are springs of probes.
    pub(crate) fn lay_out(&mut self, widths: impl Iterator<Item = usize>, probes: Range<usize>) {
        self.spans.clear();
        self.probes = probes;
        let mut start = 0;
        for width in widths {
            self.spans.push(Span { start, width, reach: 0 });
            start += width;
        }
    }

    /// Makes room for the rows of all points.
    pub(crate) fn lay_out_rows(&mut self) {
        self.sides.clear();
        let mut end = 0;
        for point in &self.points {
            let mut side = |member: usize| {
                let rows = end;
                end += 3 * self.spans[member].width;
                Side { member, rows }
            };
            let probe = point.probe.map(|probe| probe.span).filter(|span| *span != point.member);
            let rigid = point.rigid.map(|rigid| rigid.span);
            let other = point.far.map(|far| far.member).or(probe).or(rigid);
            self.sides.push([Some(side(point.member)), other.map(side)]);
        }
        self.rows.clear();
        self.rows.resize(end, 0.0);
    }

    fn width(&self) -> usize {
        self.spans.last().map_or(0, |span| span.start + span.width)
    }

    /// Ratio of the rigid response to all other compliance for a force that is shared equally by
    /// all points that would penetrate.
    pub(crate) fn rigid_share(&mut self) -> f64 {
        self.sum.clear();
        self.sum.resize(self.width(), 0.0);
        let (mut count, mut local) = (0.0, 0.0);
        for (point, sides) in self.points.iter().zip(&self.sides) {
            if point.support.is_none()
                && point.attached.is_none()
                && (point.off[0] < 0.0 || point.pushed[0] > 0.0)
            {
                count += 1.0;
                local += point.local[(0, 0)];
                for side in sides.iter().flatten() {
                    let span = self.spans[side.member];
                    let row = &self.rows[side.rows..side.rows + span.width];
                    self.sum[span.start..].iter_mut().zip(row).for_each(|(sum, row)| *sum += row);
                }
            }
        }
        let (mut rigid, mut modal) = (0.0, 0.0);
        for (member, span) in self.spans.iter().enumerate() {
            for (k, x) in self.sum[span.start..][..span.width].iter().enumerate() {
                // The spring of a probe is no rigid body.
                let is_modal = k + 6 < span.width || self.probes.contains(&member);
                let part = if is_modal { &mut modal } else { &mut rigid };
                *part += x * x;
            }
        }
        let ratio = rigid / (modal + local);
        if count > 0.0 && ratio.is_finite() { ratio } else { 0.0 }
    }

    /// Takes the tangents of the dents of points that begin to touch at about the forces that they
    /// will have.
    pub(crate) fn begin_dents(&mut self) {
        for (point, sides) in self.points.iter_mut().zip(&self.sides) {
            let Some(indent) = point.indent.filter(|_| point.pushed[0] <= 0.0) else { continue };
            let gap = point.off[0] - indent.shift;
            let mut response = 0.0;
            for side in sides.iter().flatten() {
                let row = &self.rows[side.rows..][..self.spans[side.member].width];
                response += dot(row, row);
            }
            point.linearize(if gap < 0.0 { indent.first_force(gap, response) } else { 0.0 });
        }
    }

    /// Solves the laws of all points on the responses of the bodies, which are linear. Dents that
    /// are not are solved by their tangents, again and again.
    pub(crate) fn solve(&mut self, enough: f64) {
        self.points.iter_mut().for_each(|point| point.force = point.pushed);
        for _ in 0..Self::TANGENTS {
            self.solve_linear(enough);
            if self.points.iter().map(ContactPoint::bends).fold(0.0, f64::max) <= enough {
                return;
            }
            for point in &mut self.points {
                point.linearize(point.force[0]);
            }
        }
    }

    /// Solves the laws of all points on the linearized responses.
    ///
    /// Block Gauss-Seidel sweeps go forward and backward in turn and find which points are open,
    /// stick or slide. After every few sweeps a direct solve takes that as given, which removes the
    /// slowly converging part of the error. The work ends early once no force of a sweep moves a
    /// site by more than `enough` (m).
    fn solve_linear(&mut self, enough: f64) {
        for (point, sides) in self.points.iter_mut().zip(&self.sides) {
            point.block = point.local;
            for side in sides.iter().flatten() {
                let width = self.spans[side.member].width;
                let row = |axis: usize| &self.rows[side.rows + axis * width..][..width];
                point.block += Matrix3::from_fn(|i, j| dot(row(i.min(j)), row(i.max(j))));
            }
        }
        self.sum_changes();
        let few = 3 * self.points.len() <= self.width();
        if few {
            self.fill_responses();
        }
        let affordable = self.couple();
        let mut direct = few || affordable;
        let mut last = f64::INFINITY;
        for turn in 0..Self::TURNS {
            let mut change = 0.0;
            let sweeps = if direct { Self::SWEEPS } else { 2 * Self::SWEEPS };
            for sweep in 0..sweeps {
                change = self.sweep(sweep % 2 == 1);
                if change <= enough {
                    return;
                }
            }
            if change > last && turn >= 3 && direct {
                // The set of points that slide does not settle.
                if affordable && turn + 1 < Self::TURNS && self.descend(enough) {
                    return;
                }
                // Sweeps alone contract.
                direct = false;
            }
            last = change;
            if direct && turn + 1 < Self::TURNS {
                if few {
                    self.solve_for_forces();
                } else {
                    self.solve_directly();
                }
            }
        }
    }

    /// Finds how far the coordinates of each body are coupled with those of others. Returns whether
    /// a direct solve is affordable.
    fn couple(&mut self) -> bool {
        for span in &mut self.spans {
            span.reach = span.start + span.width;
        }
        for sides in &self.sides {
            if let [Some(a), Some(b)] = sides {
                let end = self.spans[a.member.max(b.member)];
                let first = &mut self.spans[a.member.min(b.member)];
                first.reach = first.reach.max(end.start + end.width);
            }
        }
        let (mut reach, mut work) = (0, 0);
        for span in &mut self.spans {
            reach = reach.max(span.reach);
            span.reach = reach;
            work += span.width * (reach - span.start).pow(2);
        }
        self.width() <= Self::MAX_WIDTH && work <= Self::MAX_WORK
    }

    /// Recomputes the sum of the rows times the changes of the forces.
    fn sum_changes(&mut self) {
        self.sum.clear();
        self.sum.resize(self.width(), 0.0);
        for (point, sides) in self.points.iter().zip(&self.sides) {
            let change = point.force - point.pushed;
            if change == Vector3::zeros() {
                continue;
            }
            for side in sides.iter().flatten() {
                add(&self.spans[side.member], &self.rows, side, &change, &mut self.sum);
            }
        }
    }

    /// One Gauss-Seidel sweep. Returns the largest movement of a site by the change of its force,
    /// m.
    fn sweep(&mut self, back: bool) -> f64 {
        let (mut change, count) = (0.0f64, self.points.len());
        for i in 0..count {
            let i = if back { count - 1 - i } else { i };
            let (point, sides) = (&mut self.points[i], &self.sides[i]);
            let moved = along(&self.spans, &self.rows, sides, &self.sum);
            // The gap if this point had no force.
            let free = point.off + moved - (point.block - point.local) * point.force;
            let (force, status) = point.law(&point.block, &free);
            let step = force - point.force;
            (point.force, point.status) = (force, status);
            if step != Vector3::zeros() {
                change = change.max((point.block * step).amax());
                for side in sides.iter().flatten() {
                    add(&self.spans[side.member], &self.rows, side, &step, &mut self.sum);
                }
            }
        }
        self.sweeps += 1;
        change
    }
}

/// Way of a point by the coordinates of all, m, contact axes.
fn along(spans: &[Span], rows: &[f64], sides: &[Option<Side>; 2], z: &[f64]) -> Vector3<f64> {
    let mut way = Vector3::zeros();
    for side in sides.iter().flatten() {
        let span = spans[side.member];
        let z = &z[span.start..span.start + span.width];
        for (way, row) in way.iter_mut().zip(rows[side.rows..].chunks_exact(span.width)) {
            *way += dot(row, z);
        }
    }
    way
}

/// Adds the rows of one side times a force to the coordinates of all.
fn add(span: &Span, rows: &[f64], side: &Side, force: &Vector3<f64>, sum: &mut [f64]) {
    let row = |axis: usize| &rows[side.rows + axis * span.width..][..span.width];
    let [a, b, c] = [row(0), row(1), row(2)];
    let sum = &mut sum[span.start..span.start + span.width];
    for (k, sum) in sum.iter_mut().enumerate() {
        *sum += a[k] * force[0] + b[k] * force[1] + c[k] * force[2];
    }
}

//! All forces at once: by elimination, and by Newton's method where the laws do not settle.

use nalgebra::{Matrix3, RowVector3, Vector3};

use super::{Span, Touching, add, along};
use crate::{
    contact::cone::{self, Status},
    simd::dot,
};

impl Touching {
    /// Solves for all forces at once, where each point stays open, stuck or sliding in the same
    /// direction.
    ///
    /// With `z = sum rows^T (force - pushed)` a point has the force `-K (off + rows z)`, where `K`
    /// inverts its compliance. The unknown is `z`, which is as long as the bodies have coordinates.
    /// Its matrix couples only bodies that touch, and is factored within that envelope.
    pub(super) fn solve_directly(&mut self) {
        self.right.clear();
        self.right.resize(self.width(), 0.0);
        for (point, sides) in self.points.iter_mut().zip(&self.sides) {
            let stiffness = match point.status {
                Status::Open => Matrix3::zeros(),
                Status::Stick => point.local.try_inverse().unwrap_or_else(Matrix3::zeros),
                Status::Slip => {
                    // The force has a fixed direction, and the gap is zero.
                    let along = point.force / point.force[0];
                    let soft = (point.local.row(0) * along)[0];
                    if along.iter().all(|x| x.is_finite()) && soft > 0.0 {
                        along * RowVector3::new(1.0 / soft, 0.0, 0.0)
                    } else {
                        Matrix3::zeros()
                    }
                }
            };
            point.stiffness = stiffness;
            let pull = -(stiffness * point.off + point.pushed);
            for side in sides.iter().flatten() {
                add(&self.spans[side.member], &self.rows, side, &pull, &mut self.right);
            }
        }
        self.fill_matrix();
        if !eliminate(&mut self.full, &mut self.right, &self.spans) {
            return;
        }
        for (point, sides) in self.points.iter_mut().zip(&self.sides) {
            if point.status == Status::Open {
                continue;
            }
            let gap = point.off + along(&self.spans, &self.rows, sides, &self.right);
            let force = -(point.stiffness * gap);
            point.force = if point.admits(&force) { force } else { Vector3::zeros() };
        }
        self.sum_changes();
    }

    /// Computes `1 + sum rows^T stiffness rows`.
    fn fill_matrix(&mut self) {
        let width = self.width();
        self.full.clear();
        self.full.resize(width * width, 0.0);
        for (point, sides) in self.points.iter().zip(&self.sides) {
            if point.stiffness == Matrix3::zeros() {
                continue;
            }
            for side in sides.iter().flatten() {
                let span = self.spans[side.member];
                let row = |axis: usize| &self.rows[side.rows + axis * span.width..][..span.width];
                let [a, b, c] = [row(0), row(1), row(2)];
                for i in 0..span.width {
                    let [x, y, z] = *(point.stiffness.tr_mul(&Vector3::new(a[i], b[i], c[i]))).as_ref();
                    let out = &mut self.full[(span.start + i) * width..][..width];
                    for other in sides.iter().flatten() {
                        let there = self.spans[other.member];
                        let row = |axis: usize| &self.rows[other.rows + axis * there.width..][..there.width];
                        let [a, b, c] = [row(0), row(1), row(2)];
                        let out = &mut out[there.start..there.start + there.width];
                        for (k, out) in out.iter_mut().enumerate() {
                            *out += x * a[k] + y * b[k] + z * c[k];
                        }
                    }
                }
            }
        }
        (0..width).for_each(|i| self.full[i * width + i] += 1.0);
    }

    /// Solves the laws by Newton's method with a line search, which comes to an end where the set
    /// of points that slide does not settle by itself: heavy bodies on light ones. Returns whether
    /// no site is farther than `enough` (m) from its law.
    ///
    /// With `z = sum rows^T (force - pushed)` the force of a point is a function of its own gap
    /// `off + rows z` alone, because each point has a compliance of its own. The equation
    /// `z = sum rows^T (force(z) - pushed)` is the gradient of a convex function but for friction.
    pub(super) fn descend(&mut self, enough: f64) -> bool {
        self.z.clone_from(&self.sum);
        let mut length = self.apply_laws();
        for _ in 0..Self::DESCENTS {
            if !length.is_finite() {
                return false;
            }
            if self.amiss() <= enough {
                return true;
            }
            for point in &mut self.points {
                point.stiffness = cone::stiffness(&point.local, &point.force, point.slid, point.status);
            }
            self.fill_matrix();
            self.right.clone_from(&self.off_balance);
            if !eliminate(&mut self.full, &mut self.right, &self.spans) {
                return false;
            }
            self.before.clone_from(&self.z);
            let mut share = 1.0;
            let next = loop {
                let ways = self.before.iter().zip(&self.right);
                self.z.iter_mut().zip(ways).for_each(|(z, (before, way))| *z = before - share * way);
                let next = self.apply_laws();
                if next <= (1.0 - 1e-2 * share) * length || share < 1e-2 {
                    break next;
                }
                share *= 0.5;
            };
            if next >= length {
                return false;
            }
            length = next;
        }
        false
    }

    /// Takes the force of each point from its gap at the coordinates `z`. Returns the length of
    /// what is then off balance.
    fn apply_laws(&mut self) -> f64 {
        for (point, sides) in self.points.iter_mut().zip(&self.sides) {
            let gap = point.off + along(&self.spans, &self.rows, sides, &self.z);
            (point.force, point.status) = point.law(&point.local, &gap);
            point.slid = (gap + point.local * point.force).yz().norm();
        }
        self.sum_changes();
        self.off_balance.clear();
        self.off_balance.extend(self.z.iter().zip(&self.sum).map(|(z, sum)| z - sum));
        dot(&self.off_balance, &self.off_balance).sqrt()
    }

    /// Largest way of a site by what is off balance, m.
    fn amiss(&self) -> f64 {
        let way = |sides| along(&self.spans, &self.rows, sides, &self.off_balance).amax();
        self.sides.iter().map(way).fold(0.0, f64::max)
    }

    /// Computes the responses of all points to forces at all points.
    pub(super) fn fill_responses(&mut self) {
        let n = 3 * self.points.len();
        self.responses.clear();
        self.responses.resize(n * n, 0.0);
        for (i, a) in self.sides.iter().enumerate() {
            for (j, b) in self.sides[..=i].iter().enumerate() {
                for side in a.iter().flatten() {
                    let Some(other) = b.iter().flatten().find(|other| other.member == side.member) else {
                        continue;
                    };
                    let width = self.spans[side.member].width;
                    for x in 0..3 {
                        let row = &self.rows[side.rows + x * width..][..width];
                        for y in 0..3 {
                            let response = dot(row, &self.rows[other.rows + y * width..][..width]);
                            self.responses[(3 * i + x) * n + 3 * j + y] += response;
                            if i != j {
                                self.responses[(3 * j + y) * n + 3 * i + x] += response;
                            }
                        }
                    }
                }
            }
        }
    }

    /// As [`Touching::solve_directly`], with the forces as the unknowns: three of a point that
    /// sticks, one of a point that slides. It is faster where the forces are fewer than the
    /// coordinates.
    pub(super) fn solve_for_forces(&mut self) {
        let n = 3 * self.points.len();
        self.unknowns.clear();
        let mut end = 0;
        for point in &mut self.points {
            let along = point.force / point.force[0];
            if point.status == Status::Slip && !along.iter().all(|x| x.is_finite()) {
                point.status = Status::Open;
            }
            let width = match point.status {
                Status::Open => 0,
                Status::Stick => 3,
                Status::Slip => 1,
            };
            self.unknowns.push(Span { start: end, width, reach: 0 });
            end += width;
        }
        self.full.clear();
        self.full.resize(end * end, 0.0);
        self.right.clear();
        self.right.resize(end, 0.0);
        for (i, (a, of_a)) in self.points.iter().zip(&self.unknowns).enumerate() {
            for x in 0..of_a.width {
                let row = &self.responses[(3 * i + x) * n..][..n];
                let mut right = -a.off[x];
                for (j, (b, of_b)) in self.points.iter().zip(&self.unknowns).enumerate() {
                    let mut response = Vector3::new(row[3 * j], row[3 * j + 1], row[3 * j + 2]);
                    right += response.dot(&b.pushed);
                    if i == j {
                        response += a.local.row(x).transpose();
                    }
                    let out = &mut self.full[(of_a.start + x) * end + of_b.start..][..of_b.width];
                    match b.status {
                        Status::Open => {}
                        Status::Stick => out.copy_from_slice(response.as_slice()),
                        Status::Slip => out.fill(response.dot(&(b.force / b.force[0]))),
                    }
                }
                self.right[of_a.start + x] = right;
            }
        }
        let all = [Span { start: 0, width: end, reach: end }];
        if !eliminate(&mut self.full, &mut self.right, &all) {
            return;
        }
        for (point, of) in self.points.iter_mut().zip(&self.unknowns) {
            let force = match (point.status, &self.right[of.start..of.start + of.width]) {
                (Status::Stick, &[x, y, z]) => Vector3::new(x, y, z),
                (Status::Slip, &[n]) => point.force * (n / point.force[0]),
                _ => continue,
            };
            point.force = if point.admits(&force) { force } else { Vector3::zeros() };
        }
        self.sum_changes();
    }
}

/// Replaces the right side by the solution, by Gaussian elimination within the envelope of the
/// matrix. The matrix is positive definite but for friction, so it needs no exchange of rows.
/// Returns whether the solution is finite.
fn eliminate(m: &mut [f64], x: &mut [f64], spans: &[Span]) -> bool {
    let width = x.len();
    for span in spans {
        for j in span.start..span.start + span.width {
            let (above, below) = m.split_at_mut((j + 1) * width);
            let pivot = &above[j * width + j..j * width + span.reach];
            let Some((&head, tail)) = pivot.split_first() else { continue };
            for (i, row) in (j + 1..span.reach).zip(below.chunks_exact_mut(width)) {
                let factor = row[j] / head;
                if factor != 0.0 {
                    row[j + 1..span.reach].iter_mut().zip(tail).for_each(|(a, b)| *a -= factor * b);
                    x[i] -= factor * x[j];
                }
            }
        }
    }
    for span in spans.iter().rev() {
        for j in (span.start..span.start + span.width).rev() {
            let row = &m[j * width..j * width + span.reach];
            let sum: f64 = row[j + 1..].iter().zip(&x[j + 1..]).map(|(a, b)| a * b).sum();
            x[j] = (x[j] - sum) / row[j];
        }
    }
    x.iter().all(|x| x.is_finite())
}

//! The contacts of one copy of a body: what it may touch, what the last step left, and the solver.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::{
    ContactSites, Obstacle,
    cone::{self, Status},
};
use crate::{
    Hand, StepError,
    simd::dot,
    step::{System, Tangent},
};

/// A contact of the last step that carried force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// Index of the obstacle in the list of the body.
    pub obstacle: usize,
    /// Surface vertex at the center of the touching patch.
    pub vertex: u32,
    /// Position of the contact at the end of the step, m, world axes.
    pub point: [f64; 3],
    /// Outward normal of the obstacle, world axes.
    pub normal: [f64; 3],
    /// Force on the body over the step, N, world axes.
    pub force: [f64; 3],
    /// Depth of the touching surface inside the obstacle at the end of the step, m, 0 or more. The
    /// surface includes the residual flexibility of the patch, which the modes leave out.
    pub penetration: f64,
    /// Whether the contact slides.
    pub sliding: bool,
}

/// Sums and quality of the contacts of the last step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ContactReport {
    /// Number of contacts with force.
    pub contacts: usize,
    /// Number of places that were looked at.
    pub candidates: usize,
    /// Sum of the forces on the body over the step, N, world axes.
    pub force: [f64; 3],
    /// Largest penetration of a contact, m.
    pub penetration: f64,
    /// Energy in the residual flexibility of the sites at the end of the step, J. The energy of the
    /// body does not include it.
    pub energy: f64,
    /// Number of times that the step was computed, at least 1.
    pub rounds: usize,
    /// Number of Gauss-Seidel sweeps in all rounds.
    pub sweeps: usize,
    /// Largest violation of the laws of contact at the end of the step, m.
    pub residual: f64,
    /// Whether the step was repeated with more dissipation, because it would have added energy.
    pub guarded: bool,
}

/// A contact of the last step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Memory {
    pub(crate) obstacle: usize,
    pub(crate) site: usize,
    /// Force on the body, N, world axes.
    pub(crate) force: Vector3<f64>,
    /// Where the surface of the site sticks, m, world axes.
    pub(crate) anchor: Vector3<f64>,
    /// Direction from the site's center to its contact point, body axes.
    pub(crate) toward: Vector3<f64>,
}

/// A place that touches, or may touch, in this step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    pub(crate) obstacle: usize,
    pub(crate) site: usize,
    /// Directions from the site's center to the contact point at the beginning and at the end of
    /// the step, body axes.
    pub(crate) first: Vector3<f64>,
    pub(crate) last: Vector3<f64>,
    /// Position of the first contact point's material at the beginning and at the end, m, world
    /// axes. The position of the last contact point at the end.
    pub(crate) start: Vector3<f64>,
    pub(crate) end: Vector3<f64>,
    pub(crate) place: Vector3<f64>,
    /// Way of the obstacle's surface in the step, m, world axes.
    pub(crate) carried: Vector3<f64>,
    pub(crate) anchor: Vector3<f64>,
    /// Whether the contact has had a force before, so that its anchor holds.
    pub(crate) old: bool,
    /// Force at the end of the step before, N, world axes.
    pub(crate) before: Vector3<f64>,
    /// Gap at the beginning of the step and the smallest gap allowed at its end, m.
    pub(crate) gap: f64,
    pub(crate) floor: f64,
    /// Rows: normal and two tangents, world axes.
    pub(crate) axes: Matrix3<f64>,
    /// Compliance of the site, m/N, world axes.
    pub(crate) compliance: Matrix3<f64>,
    /// Compliance of the site in contact axes, and with the response to its own force.
    local: Matrix3<f64>,
    block: Matrix3<f64>,
    /// Inverse of the compliance in the direct solve, N/m.
    stiffness: Matrix3<f64>,
    /// Gap and tangential offset at the end of the last computed step without the compliance, m,
    /// contact axes.
    pub(crate) off: Vector3<f64>,
    /// Force of the last computed step, and of the solve, N, contact axes.
    pub(crate) pushed: Vector3<f64>,
    pub(crate) force: Vector3<f64>,
    pub(crate) status: Status,
    /// Derivative of the site's position by the six numbers of its patch, world axes: at the
    /// beginning of the step, and its mean over the step, by which forces act on the modes. The
    /// mean stays as the first computed step has it.
    pub(crate) tangent: Tangent,
    pub(crate) mean: Option<Tangent>,
    /// Arm of the contact about the center of mass, m, world axes.
    pub(crate) arm: Vector3<f64>,
}

impl Point {
    pub(crate) fn new(obstacle: usize, site: usize) -> Self {
        let zero = Vector3::zeros();
        Self {
            obstacle,
            site,
            first: zero,
            last: zero,
            start: zero,
            end: zero,
            place: zero,
            carried: zero,
            anchor: zero,
            old: false,
            before: zero,
            gap: 0.0,
            floor: 0.0,
            axes: Matrix3::identity(),
            compliance: Matrix3::zeros(),
            local: Matrix3::zeros(),
            block: Matrix3::zeros(),
            stiffness: Matrix3::zeros(),
            off: zero,
            pushed: zero,
            force: zero,
            status: Status::Open,
            tangent: Tangent::zeros(),
            mean: None,
            arm: zero,
        }
    }

    /// Force of the last computed step, N, world axes.
    pub(crate) fn world_force(&self) -> Vector3<f64> {
        self.axes.tr_mul(&self.pushed)
    }

    /// Turns the axes to a normal. The forces keep their direction in the world.
    pub(crate) fn turn(&mut self, normal: &Vector3<f64>) {
        let (pushed, force) = (self.axes.tr_mul(&self.pushed), self.axes.tr_mul(&self.force));
        let least = normal.iamin();
        let first = normal.cross(&Vector3::ith(least, 1.0)).normalize();
        let second = normal.cross(&first);
        self.axes = Matrix3::from_rows(&[normal.transpose(), first.transpose(), second.transpose()]);
        self.local = self.axes * self.compliance * self.axes.transpose();
        (self.pushed, self.force) = (self.axes * pushed, self.axes * force);
    }

    /// Gap and offset of the surface at the end of the last computed step, m, contact axes.
    pub(crate) fn surface(&self) -> Vector3<f64> {
        self.off + self.local * self.pushed
    }

    /// Violation of the laws at the end of the last computed step, m.
    fn violation(&self, friction: f64) -> f64 {
        let u = self.surface();
        let (n, t) = (self.pushed[0], self.pushed[1].hypot(self.pushed[2]));
        if n <= 0.0 {
            return (-u[0]).max(0.0);
        }
        let most = friction * n;
        let slid = if t < most * (1.0 - 1e-9) || t == 0.0 && most > 0.0 {
            u[1].hypot(u[2])
        } else if t > 0.0 {
            // Sliding may only be against the force.
            let along = (u[1] * self.pushed[1] + u[2] * self.pushed[2]) / t;
            let across = (u[1] * self.pushed[2] - u[2] * self.pushed[1]) / t;
            // A force beyond the cone is a violation too.
            let beyond = (t - most).max(0.0) * self.local[(1, 1)];
            let beyond = if t > most * (1.0 + 1e-9) { beyond } else { 0.0 };
            along.max(0.0).hypot(across) + beyond
        } else {
            0.0
        };
        u[0].abs().hypot(slid)
    }
}

/// Workspace of the contacts in a step.
#[derive(Debug, Clone, Default)]
pub(crate) struct Touching {
    pub(crate) points: Vec<Point>,
    /// Three rows per point, each of one entry per coordinate and six for the frame, such that the
    /// response of point `i` to forces at point `j` is `rows_i rows_j^T`.
    pub(crate) rows: Vec<f64>,
    /// What the hands hold back of the responses, one row for each of their directions.
    pub(crate) held: Vec<f64>,
    /// Sum of `rows^T` times the changes of the forces.
    sum: Vec<f64>,
    /// The direct solve, and its matrix while it is summed.
    matrix: System,
    full: Vec<f64>,
    /// Marks of the sites that have a point with the current obstacle.
    pub(crate) marks: Vec<u32>,
    pub(crate) stamp: u32,
    /// Pull, mean pull and flow of the hands before the step.
    pub(crate) hands: Vec<[Vector3<f64>; 3]>,
    pub(crate) sweeps: usize,
}

impl Touching {
    /// Largest number of direct solves, and of sweeps before each.
    const TURNS: usize = 12;
    const SWEEPS: usize = 3;

    /// Largest violation of the laws at the end of the last computed step, m.
    pub(crate) fn violation(&self, friction: f64) -> f64 {
        self.points.iter().map(|point| point.violation(friction)).fold(0.0, f64::max)
    }

    /// Reserves memory for this number of points.
    fn reserve(&mut self, points: usize, width: usize) {
        self.points.reserve(points.saturating_sub(self.points.len()));
        self.rows.reserve((3 * points * width).saturating_sub(self.rows.len()));
        self.sum.reserve(width.saturating_sub(self.sum.len()));
        self.full.reserve((width * width).saturating_sub(self.full.len()));
        self.matrix.reserve(width.div_ceil(3));
    }

    /// Ratio of the rigid response to all other compliance for a force that is shared equally by
    /// all points that would penetrate.
    pub(crate) fn rigid_share(&mut self, width: usize) -> f64 {
        self.sum.clear();
        self.sum.resize(width, 0.0);
        let (mut count, mut local) = (0.0, 0.0);
        for (point, rows) in self.points.iter().zip(self.rows.chunks_exact(3 * width)) {
            if point.off[0] < 0.0 || point.pushed[0] > 0.0 {
                count += 1.0;
                local += point.local[(0, 0)];
                self.sum.iter_mut().zip(&rows[..width]).for_each(|(sum, row)| *sum += row);
            }
        }
        let (modal, rigid) = self.sum.split_at(width - 6);
        let square = |part: &[f64]| part.iter().map(|x| x * x).sum::<f64>();
        let ratio = square(rigid) / (square(modal) + local);
        if count > 0.0 && ratio.is_finite() { ratio } else { 0.0 }
    }

    /// Solves the laws of all points on the linearized responses.
    ///
    /// Block Gauss-Seidel sweeps go forward and backward in turn and find which points are open,
    /// stick or slide. After every few sweeps a direct solve takes that as given, which removes the
    /// slowly converging part of the error. The work ends early once no force of a sweep moves a
    /// site by more than `enough` (m).
    pub(crate) fn solve(&mut self, width: usize, friction: f64, enough: f64) {
        for (point, rows) in self.points.iter_mut().zip(self.rows.chunks_exact(3 * width)) {
            let row = |axis: usize| &rows[axis * width..(axis + 1) * width];
            point.block = point.local + Matrix3::from_fn(|i, j| dot(row(i.min(j)), row(i.max(j))));
            point.force = point.pushed;
        }
        self.sum_changes(width);
        let mut direct = true;
        let mut last = f64::INFINITY;
        for turn in 0..Self::TURNS {
            let mut change = 0.0;
            let sweeps = if direct { Self::SWEEPS } else { 2 * Self::SWEEPS };
            for sweep in 0..sweeps {
                change = self.sweep(width, friction, sweep % 2 == 1);
                if change <= enough {
                    return;
                }
            }
            if change > last {
                // The set of points that slide does not settle. Sweeps alone contract.
                direct = turn < 3;
            }
            last = change;
            if direct && turn + 1 < Self::TURNS {
                self.solve_directly(width, friction);
            }
        }
    }

    /// Recomputes the sum of the rows times the changes of the forces.
    fn sum_changes(&mut self, width: usize) {
        self.sum.clear();
        self.sum.resize(width, 0.0);
        for (point, rows) in self.points.iter().zip(self.rows.chunks_exact(3 * width)) {
            let change = point.force - point.pushed;
            for (change, row) in change.iter().zip(rows.chunks_exact(width)) {
                if *change != 0.0 {
                    self.sum.iter_mut().zip(row).for_each(|(sum, row)| *sum += change * row);
                }
            }
        }
    }

    /// One Gauss-Seidel sweep. Returns the largest movement of a site by the change of its force,
    /// m.
    fn sweep(&mut self, width: usize, friction: f64, back: bool) -> f64 {
        let (mut change, count) = (0.0f64, self.points.len());
        for i in 0..count {
            let i = if back { count - 1 - i } else { i };
            let point = &mut self.points[i];
            let rows = &self.rows[3 * i * width..3 * (i + 1) * width];
            let [a, b, c] = [0, 1, 2].map(|axis| &rows[axis * width..(axis + 1) * width]);
            let moved = Vector3::new(dot(a, &self.sum), dot(b, &self.sum), dot(c, &self.sum));
            // The gap if this point had no force.
            let free = point.off + moved - (point.block - point.local) * point.force;
            let (force, status) = cone::solve(&point.block, &free, friction, &point.force);
            let step = force - point.force;
            (point.force, point.status) = (force, status);
            if step != Vector3::zeros() {
                for (k, sum) in self.sum.iter_mut().enumerate() {
                    *sum += a[k] * step[0] + b[k] * step[1] + c[k] * step[2];
                }
                change = change.max((point.block * step).amax());
            }
        }
        self.sweeps += 1;
        change
    }

    /// Solves for all forces at once, where each point stays open, stuck or sliding in the same
    /// direction.
    ///
    /// With `z = sum rows^T (force - pushed)` a point has the force `-K (off + rows z)`, where `K`
    /// inverts its compliance. The unknown is `z`, which is as long as the body has coordinates.
    fn solve_directly(&mut self, width: usize, friction: f64) {
        self.matrix.clear(width, friction == 0.0);
        self.full.clear();
        self.full.resize(width * width, 0.0);
        let right = self.matrix.right();
        for (point, rows) in self.points.iter_mut().zip(self.rows.chunks_exact(3 * width)) {
            let stiffness = match point.status {
                Status::Open => Matrix3::zeros(),
                Status::Stick => point.local.try_inverse().unwrap_or_else(Matrix3::zeros),
                Status::Slip => {
                    // The force has a fixed direction, and the gap is zero.
                    let along = point.force / point.force[0];
                    let soft = (point.local.row(0) * along)[0];
                    if along.iter().all(|x| x.is_finite()) && soft > 0.0 {
                        along * nalgebra::RowVector3::new(1.0 / soft, 0.0, 0.0)
                    } else {
                        Matrix3::zeros()
                    }
                }
            };
            point.stiffness = stiffness;
            let pull = stiffness * point.off + point.pushed;
            for (axis, row) in rows.chunks_exact(width).enumerate() {
                right.iter_mut().zip(row).for_each(|(right, row)| *right -= pull[axis] * row);
            }
            if point.status == Status::Open {
                continue;
            }
            let [a, b, c] = [0, 1, 2].map(|axis| &rows[axis * width..(axis + 1) * width]);
            let symmetric = friction == 0.0;
            for (i, out) in self.full.chunks_exact_mut(width).enumerate() {
                let [x, y, z] = *(stiffness.transpose() * Vector3::new(a[i], b[i], c[i])).as_ref();
                let most = if symmetric { i + 1 } else { width };
                for (k, out) in out[..most].iter_mut().enumerate() {
                    *out += x * a[k] + y * b[k] + z * c[k];
                }
            }
        }
        for i in 0..width {
            for j in 0..if friction == 0.0 { i + 1 } else { width } {
                let own = if i == j { 1.0 } else { 0.0 };
                self.matrix.set(i, j, self.full[i * width + j] + own);
            }
        }
        self.matrix.solve();
        let z = self.matrix.right();
        if !z.iter().all(|x| x.is_finite()) {
            return;
        }
        for (point, rows) in self.points.iter_mut().zip(self.rows.chunks_exact(3 * width)) {
            if point.status == Status::Open {
                continue;
            }
            let row = |axis: usize| dot(&rows[axis * width..(axis + 1) * width], z);
            let force = -(point.stiffness * (point.off + Vector3::new(row(0), row(1), row(2))));
            point.force = if force[0] > 0.0 { force } else { Vector3::zeros() };
        }
        self.sum_changes(width);
    }
}

/// What one copy of a body may touch, and what the contacts of the last step left for the next.
///
/// It belongs to the state of the body: whoever steps a [`State`](crate::State) with contacts keeps
/// one of these beside it. See [`Kernel::step_touching`](crate::Kernel::step_touching).
#[derive(Debug, Clone)]
pub struct Contacts {
    friction: f64,
    obstacles: Vec<Arc<dyn Obstacle>>,
    pub(crate) places: Option<Arc<ContactSites>>,
    /// Modes of the body for which the sites were made.
    pub(crate) modes: usize,
    pub(crate) memory: Vec<Memory>,
    pub(crate) touching: Touching,
    /// Weight of a contact force in the way of the frame within a step, see the kernel.
    pub(crate) theta: f64,
    /// Energy that steps with contacts have lost and not gained since, J.
    pub(crate) lost: f64,
    pub(crate) list: Vec<Contact>,
    pub(crate) report: ContactReport,
}

impl Default for Contacts {
    fn default() -> Self {
        Self {
            friction: Self::FRICTION,
            obstacles: Vec::new(),
            places: None,
            modes: 0,
            memory: Vec::new(),
            touching: Touching::default(),
            theta: 0.5,
            lost: 0.0,
            list: Vec::new(),
            report: ContactReport::default(),
        }
    }
}

impl Contacts {
    /// Default coefficient of friction.
    pub const FRICTION: f64 = 0.5;

    /// Largest coefficient of friction.
    pub const MOST_FRICTION: f64 = 10.0;

    /// The coefficient of Coulomb friction between the body and all obstacles, for sticking and
    /// sliding. Default: [`Contacts::FRICTION`].
    pub fn friction(&self) -> f64 {
        self.friction
    }

    /// Sets the coefficient of friction, 0 to [`Contacts::MOST_FRICTION`].
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for another number. The old one then stays.
    pub fn set_friction(&mut self, friction: f64) -> Result<(), StepError> {
        let sound = (0.0..=Self::MOST_FRICTION).contains(&friction);
        StepError::check("friction", "0 to 10", sound, friction)?;
        self.friction = friction;
        Ok(())
    }

    /// The obstacles that the body may touch.
    pub fn obstacles(&self) -> &[Arc<dyn Obstacle>] {
        &self.obstacles
    }

    /// Sets the obstacles that the body may touch. Contacts with an obstacle go on with the one at
    /// the same index of the new list.
    ///
    /// # Errors
    /// Returns the error of [`Obstacle::check`]. The old obstacles then stay.
    pub fn set_obstacles(&mut self, obstacles: Vec<Arc<dyn Obstacle>>) -> Result<(), StepError> {
        obstacles.iter().try_for_each(|obstacle| obstacle.check())?;
        self.memory.retain(|memory| memory.obstacle < obstacles.len());
        self.obstacles = obstacles;
        Ok(())
    }

    /// The contacts of the last step that carried force, in the order of obstacles and sites.
    pub fn contacts(&self) -> &[Contact] {
        &self.list
    }

    /// Number of places at which the body may touch. Zero until obstacles are set.
    pub fn sites(&self) -> usize {
        self.places.as_ref().map_or(0, |sites| sites.sites.len())
    }

    /// Sums and quality of the last step's contacts.
    pub fn report(&self) -> &ContactReport {
        &self.report
    }

    /// Forgets the forces and anchors of the last step. A body whose state was set from elsewhere
    /// must forget them.
    pub fn forget(&mut self) {
        self.memory.clear();
        self.list.clear();
        self.report = ContactReport::default();
        self.theta = 0.5;
        self.lost = 0.0;
    }

    /// Gives hands what they had before a step that failed.
    pub(crate) fn restore(&mut self, hands: &mut [Hand]) {
        for (hand, [pull, mean, flow]) in hands.iter_mut().zip(&self.touching.hands) {
            (hand.pull, hand.mean, hand.flow) = (*pull, *mean, *flow);
        }
    }

    /// Takes over the sites of a body with `modes` modes and reserves memory.
    pub(crate) fn adopt(&mut self, sites: Arc<ContactSites>, modes: usize) {
        let count = sites.sites.len();
        let points = count * self.obstacles.len().min(2);
        self.touching.reserve(points, modes + 6);
        self.touching.marks.clear();
        self.touching.marks.resize(count, 0);
        self.touching.stamp = 0;
        self.memory.reserve(points.saturating_sub(self.memory.len()));
        self.list.reserve(points.saturating_sub(self.list.len()));
        if self.modes != modes {
            self.memory.clear();
        }
        self.modes = modes;
        self.places = Some(sites);
    }
}

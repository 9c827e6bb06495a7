//! Contact at device rate: the planes that the tool's ball touches.
//!
//! The simulation publishes what its own ball touches and what is near it as planes
//! ([`TouchPlane`]). The loop holds a ball of its own by the same spring and solves the same law of
//! contact with these planes in every period, as [`pliant_modal::Probe`] does once a step. So the
//! force is there when the hand meets a surface and gone when it leaves, whatever the rate of the
//! simulation, and it never pulls.

use nalgebra::{Matrix3, Vector3};
use pliant_modal::contact_force;

use crate::{LocalModel, MAX_PLANES, TouchPlane, control_loop::tool::Tool};

/// Longest time that a plane is extrapolated with its last velocity, and longest time that a
/// correction takes, s.
const LONGEST: f64 = 0.05;
/// Number of sweeps over the planes. The forces of a step are the first guess of the next.
const SWEEPS: usize = 12;

/// Forces of the planes, world axes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TouchForces {
    pub(crate) elastic: Vector3<f64>,
    pub(crate) damping: Vector3<f64>,
    /// Energy in the spring and the dents, J.
    pub(crate) stored: f64,
}

/// A plane between two updates.
#[derive(Debug, Clone, Copy, Default)]
struct TouchSlot {
    plane: TouchPlane,
    /// Height by which the plane lies behind the received one, m, and how fast this decays, m/s.
    lag: f64,
    rate: f64,
    /// Where the ball's center sticks, m. Set while the plane is touched.
    anchor: Option<Vector3<f64>>,
    /// Force on the ball: along the normal and two tangents, N.
    force: Vector3<f64>,
}

impl TouchSlot {
    /// Distance of the ball to the received plane after `age` seconds, m.
    fn gap(&self, center: &Vector3<f64>, radius: f64, age: f64) -> f64 {
        let at = Vector3::from(self.plane.point) + Vector3::from(self.plane.velocity) * age;
        Vector3::from(self.plane.normal).dot(&(center - at)) - radius
    }

    /// Rows: the normal and two tangents.
    fn axes(&self) -> Matrix3<f64> {
        let normal = Vector3::from(self.plane.normal);
        let first = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
        let second = normal.cross(&first);
        Matrix3::from_rows(&[normal.transpose(), first.transpose(), second.transpose()])
    }

    fn compliance(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|r, c| self.plane.compliance[r][c])
    }
}

/// The contact of a tool's ball with the planes of the local model.
#[derive(Debug, Default)]
pub(crate) struct Touch {
    slots: [TouchSlot; MAX_PLANES],
    count: usize,
    tick: u64,
    since: f64,
    touches: bool,
}

impl Touch {
    /// Forgets the contacts.
    pub(crate) fn rest(&mut self) {
        *self = Self::default();
    }

    /// Whether a plane pushed the ball in the last period.
    pub(crate) fn touches(&self) -> bool {
        self.touches
    }

    /// Takes the planes of a new update. A plane that is touched goes on where it was, and from
    /// there to where the update has it. Another plane in which the ball already is begins at the
    /// ball, without force.
    fn take(&mut self, now: f64, age: f64, model: &LocalModel, center: &Vector3<f64>) {
        let radius = model.ball.radius;
        let (old, known) = (self.slots, self.count);
        (self.tick, self.since) = (model.tick, now);
        self.count = model.planes().len();
        let interval = interval(model).max(1e-3);
        for (slot, plane) in self.slots.iter_mut().zip(model.planes()) {
            let last = old[..known].iter().find(|slot| slot.plane.key == plane.key);
            let touched = last.filter(|slot| slot.force.x > 0.0);
            *slot = TouchSlot { plane: *plane, ..touched.copied().unwrap_or_default() };
            let gap = slot.gap(center, radius, 0.0);
            slot.lag = match touched {
                Some(last) => last.gap(center, radius, age) + last.lag - gap,
                None => (-gap).max(0.0),
            };
            slot.rate = slot.lag.abs() / interval;
            // The force keeps its direction in the world.
            slot.force =
                touched.map_or_else(Vector3::zeros, |last| slot.axes() * last.axes().tr_mul(&last.force));
        }
    }

    /// Returns the forces of this tick on the ball of a tool at its present pose.
    ///
    /// The ball's center is at `x + sum f / k` for a tool at `x` and the forces `f` of the planes,
    /// and each force obeys the law of contact with the dent of its plane.
    pub(crate) fn forces(&mut self, now: f64, dt: f64, tool: &Tool, model: &LocalModel) -> TouchForces {
        let (center, ball) = (tool.position, &model.ball);
        let age = |now: f64, since: f64| (now - since).clamp(0.0, interval(model));
        if model.tick != self.tick {
            self.take(now, age(now, self.since), model, &center);
        }
        let age = age(now, self.since);
        let mut out = TouchForces::default();
        self.touches = false;
        if tool.is_clutched() || self.count == 0 || ball.stiffness <= 0.0 {
            self.slots.iter_mut().for_each(|slot| (slot.anchor, slot.force) = (None, Vector3::zeros()));
            return out;
        }
        let soft = 1.0 / ball.stiffness;
        let slots = &mut self.slots[..self.count];
        let mut total = Vector3::zeros();
        for slot in &mut *slots {
            slot.lag -= slot.lag.clamp(-slot.rate * dt, slot.rate * dt);
            if let Some(anchor) = &mut slot.anchor {
                *anchor += Vector3::from(slot.plane.velocity) * dt;
            }
            total += slot.axes().tr_mul(&slot.force);
        }
        for _ in 0..SWEEPS {
            let mut moved = 0.0f64;
            for slot in &mut *slots {
                let axes = slot.axes();
                let response = axes * slot.compliance() * axes.transpose() + Matrix3::identity() * soft;
                let others = total - axes.tr_mul(&slot.force);
                let free_center = center + others * soft;
                let gap = slot.gap(&free_center, ball.radius, age) + slot.lag;
                let anchor = slot.anchor.unwrap_or(center);
                let along = axes * (free_center - anchor);
                let free = Vector3::new(gap, along[1], along[2]);
                let (force, _) = contact_force(&response, &free, slot.plane.friction, &slot.force);
                moved = moved.max((force - slot.force).norm());
                slot.force = force;
                total = others + axes.tr_mul(&force);
            }
            if moved < 1e-9 {
                break;
            }
        }
        let at = center + total * soft;
        for slot in slots {
            if slot.force.x <= 0.0 {
                (slot.anchor, slot.force) = (None, Vector3::zeros());
                continue;
            }
            self.touches = true;
            let axes = slot.axes();
            let force = axes.tr_mul(&slot.force);
            let dent = slot.compliance() * force;
            let held = slot.force.y.hypot(slot.force.z);
            let most = slot.plane.friction * slot.force.x;
            let sticks = held < most * (1.0 - 1e-9);
            // A contact that slides takes its anchor along.
            slot.anchor = if sticks { slot.anchor.or(Some(center)) } else { Some(at + dent) };
            out.stored += 0.5 * force.dot(&dent);
            // The damper is in series with the dent as the spring is. It never pushes harder than
            // the spring, so that neither the first touch nor the last is an impulse, and it stays
            // in the cone.
            let normal = Vector3::from(slot.plane.normal);
            let damping = ball.relaxation / (soft + normal.dot(&(slot.compliance() * normal)));
            let mut drag = axes * (Vector3::from(slot.plane.velocity) - tool.velocity) * damping;
            drag.x = drag.x.clamp(-slot.force.x, slot.force.x);
            let normal = slot.force.x + drag.x;
            let mut across = Vector3::new(0.0, slot.force.y, slot.force.z);
            if sticks {
                across += Vector3::new(0.0, drag.y, drag.z);
            }
            let most = slot.plane.friction * normal;
            if across.norm() > most {
                across *= most / across.norm();
            }
            out.elastic += force;
            out.damping += axes.tr_mul(&(across + Vector3::x() * normal)) - force;
        }
        out.stored += 0.5 * soft * total.norm_squared();
        out
    }
}

/// Time for which a plane goes on with its velocity, and in which it is corrected, s.
fn interval(model: &LocalModel) -> f64 {
    let interval = if model.interval > 0.0 { model.interval } else { model.period };
    interval.clamp(0.0, LONGEST)
}

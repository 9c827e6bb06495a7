//! Contact at device rate: the planes that the tool touches.
//!
//! The simulation publishes what its own probe touches and what is near it as planes
//! ([`TouchPlane`]), each with the place of the probe. The loop holds a probe of its own by the
//! same spring and solves the same law of contact with these planes in every period, as
//! [`pliant_modal::Probe`] does once a step. So the force is there when the hand meets a surface
//! and gone when it leaves, whatever the rate of the simulation, and it never pulls.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
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
    /// Torque of both about the tool point, N m.
    pub(crate) torque: Vector3<f64>,
    /// Energy in the spring and the dents, J.
    pub(crate) stored: f64,
}

/// A plane between two updates.
#[derive(Debug, Clone, Copy, Default)]
struct TouchSlot {
    plane: TouchPlane,
    /// Outward normal in this period and at the last update, unit length, world axes. It turns from
    /// the one to that of the plane until the next update.
    normal: Vector3<f64>,
    from: Vector3<f64>,
    /// Height by which the plane lies behind the received one, m, and how fast this decays, m/s.
    lag: f64,
    rate: f64,
    /// The force along the normal, N, that it had when an update came without it. From there on it
    /// yields to less and less, so that what stands beside it takes over as slowly.
    leaves: Option<f64>,
    /// Where the center of the sphere sticks, m. Set while the plane is touched.
    anchor: Option<Vector3<f64>>,
    /// Velocity of the anchor until the next update, m/s.
    drift: Vector3<f64>,
    /// Force on the tool: along the normal and two tangents, N.
    force: Vector3<f64>,
}

/// The tool in a period.
#[derive(Debug, Clone, Copy)]
struct Held {
    position: Vector3<f64>,
    orientation: UnitQuaternion<f64>,
    radius: f64,
    /// Way for a force, m/N, and turn for a torque, rad/(N m).
    soft: f64,
    turning: f64,
}

/// Sum of the forces on the tool, N, and of their torques about the tool point, N m.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    force: Vector3<f64>,
    torque: Vector3<f64>,
}

impl Sum {
    fn add(&mut self, force: &Vector3<f64>, arm: &Vector3<f64>) {
        self.force += force;
        self.torque += arm.cross(force);
    }
}

impl Held {
    /// Center of the sphere at a place of the tool where the hand has it, m, world axes.
    fn center(&self, plane: &TouchPlane) -> Vector3<f64> {
        self.position + self.orientation * Vector3::from(plane.spot)
    }

    /// From the tool point to where a plane touches, m, world axes.
    fn arm(&self, slot: &TouchSlot) -> Vector3<f64> {
        self.orientation * Vector3::from(slot.plane.spot) - self.radius * slot.normal
    }

    /// Displacement by the spring's give at an arm, m.
    fn give(&self, sum: &Sum, arm: &Vector3<f64>) -> Vector3<f64> {
        sum.force * self.soft + (sum.torque * self.turning).cross(arm)
    }

    /// Displacement at an arm for a force there, m/N, world axes.
    fn response(&self, arm: &Vector3<f64>) -> Matrix3<f64> {
        let turns = Matrix3::identity() * arm.norm_squared() - arm * arm.transpose();
        Matrix3::identity() * self.soft + turns * self.turning
    }
}

impl TouchSlot {
    /// Distance of a sphere to the received plane after `age` seconds, m.
    fn gap(&self, center: &Vector3<f64>, radius: f64, age: f64) -> f64 {
        let at = Vector3::from(self.plane.point) + Vector3::from(self.plane.velocity) * age;
        self.normal.dot(&(center - at)) - radius
    }

    /// Turns the normal to where it is at a share of the way to that of the plane.
    fn turn(&mut self, share: f64) {
        let to = Vector3::from(self.plane.normal);
        self.normal = (self.from + (to - self.from) * share).try_normalize(0.1).unwrap_or(to);
    }

    /// Rows: the normal and two tangents.
    fn axes(&self) -> Matrix3<f64> {
        let normal = self.normal;
        let first = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
        let second = normal.cross(&first);
        Matrix3::from_rows(&[normal.transpose(), first.transpose(), second.transpose()])
    }

    fn compliance(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|r, c| self.plane.compliance[r][c])
    }
}

/// Room for the planes of an update and for those that leave.
const SLOTS: usize = 2 * MAX_PLANES;

/// The contact of a tool with the planes of the local model.
#[derive(Debug, Default)]
pub(crate) struct Touch {
    slots: [TouchSlot; SLOTS],
    count: usize,
    tick: u64,
    since: f64,
    touches: bool,
    /// Orientation of the tool in the last period.
    orientation: UnitQuaternion<f64>,
}

impl Touch {
    /// Forgets the contacts.
    pub(crate) fn rest(&mut self) {
        *self = Self::default();
    }

    /// Whether a plane pushed the tool in the last period.
    pub(crate) fn touches(&self) -> bool {
        self.touches
    }

    /// Takes the planes of a new update. Each force is at first what it was, and goes from there to
    /// what the update has. A plane that goes on with the force of an old one begins where it gives
    /// this force, and turned as the old one: its dent may be several times as soft or as stiff,
    /// since a place shares its site with others that come and go. A plane in which the tool
    /// already is begins at the tool, without force. One that is touched and that the update has no
    /// more pushes less and less.
    fn take(&mut self, now: f64, model: &LocalModel, held: &Held) {
        let (old, known) = (self.slots, self.count);
        (self.tick, self.since) = (model.tick, now);
        self.count = model.planes().len();
        let interval = interval(model).max(1e-3);
        let of = matches(&old[..known], model.planes(), held);
        for ((slot, plane), of) in self.slots.iter_mut().zip(model.planes()).zip(of) {
            let touched = of.and_then(|of| old.get(of));
            let normal = touched.map_or_else(|| Vector3::from(plane.normal), |last| last.normal);
            let force = touched.map_or_else(Vector3::zeros, |last| last.force);
            *slot = TouchSlot { plane: *plane, normal, from: normal, force, ..TouchSlot::default() };
            // What sticks keeps its way from the tool in the end, and its force at first.
            slot.anchor =
                touched.and_then(|last| Some(last.anchor? + (held.center(plane) - held.center(&last.plane))));
        }
        let loaded = old[..known].iter().enumerate().filter(|(_, slot)| slot.force.x > 0.0);
        for (number, last) in loaded {
            if of.contains(&Some(number)) {
                continue;
            }
            let Some(slot) = self.slots.get_mut(self.count) else { break };
            *slot = TouchSlot { leaves: Some(last.force.x), from: last.normal, ..*last };
            (slot.plane.normal, slot.plane.velocity) = (last.normal.into(), [0.0; 3]);
            self.count += 1;
        }
        let slots = &mut self.slots[..self.count];
        let mut total = Sum::default();
        for slot in &*slots {
            total.add(&slot.axes().tr_mul(&slot.force), &held.arm(slot));
        }
        for slot in slots {
            let (axes, arm) = (slot.axes(), held.arm(slot));
            let at = held.center(&slot.plane) + held.give(&total, &arm);
            let dent = slot.compliance() * axes.tr_mul(&slot.force);
            let gap = slot.gap(&at, held.radius, 0.0) + slot.normal.dot(&dent);
            if slot.force.x > 0.0 {
                let anchor = at + dent;
                slot.drift = (slot.anchor.unwrap_or(anchor) - anchor) / interval;
                (slot.lag, slot.anchor) = (-gap, Some(anchor));
            } else {
                slot.lag = (-gap).max(0.0);
            }
            slot.rate = if slot.leaves.is_some() { 0.0 } else { slot.lag.abs() / interval };
        }
    }

    /// Returns the forces of this tick on a tool at its present pose.
    ///
    /// The tool point is at `x + sum f / k` for a tool at `x` and the forces `f` of the planes, and
    /// the torque of these turns the tool against `k l^2`. Each force obeys the law of contact with
    /// the dent of its plane. The damper knows how fast the tool point goes, and not how fast the
    /// tool turns.
    pub(crate) fn forces(&mut self, now: f64, dt: f64, tool: &Tool, model: &LocalModel) -> TouchForces {
        let ball = &model.ball;
        let soft = if ball.stiffness > 0.0 { 1.0 / ball.stiffness } else { 0.0 };
        let turning = if ball.lever > 0.0 { soft / (ball.lever * ball.lever) } else { 0.0 };
        let (position, orientation) = (tool.position, tool.orientation);
        let held = Held { position, orientation, radius: ball.radius, soft, turning };
        if model.tick != self.tick {
            self.take(now, model, &held);
        }
        let age = (now - self.since).clamp(0.0, interval(model));
        let share = ((now - self.since) / interval(model).max(1e-3)).clamp(0.0, 1.0);
        let turned = orientation * std::mem::replace(&mut self.orientation, orientation).inverse();
        let mut out = TouchForces::default();
        self.touches = false;
        if tool.is_clutched() || self.count == 0 || soft <= 0.0 {
            self.slots.iter_mut().for_each(|slot| (slot.anchor, slot.force) = (None, Vector3::zeros()));
            return out;
        }
        let slots = &mut self.slots[..self.count];
        let mut total = Sum::default();
        for slot in &mut *slots {
            let force = slot.axes().tr_mul(&slot.force);
            slot.turn(share);
            slot.force = slot.axes() * force;
            slot.lag -= slot.lag.min(slot.rate * dt).max(-slot.rate * dt);
            if let Some(anchor) = &mut slot.anchor {
                *anchor += Vector3::from(slot.plane.velocity) * dt;
                if share < 1.0 {
                    *anchor += slot.drift * dt;
                }
                if turning > 0.0 {
                    // A tool that turns takes what touches along, but not the center of its sphere.
                    let below = -held.radius * slot.normal;
                    *anchor -= turned * below - below;
                }
            }
            total.add(&force, &held.arm(slot));
        }
        for _ in 0..SWEEPS {
            let mut moved = 0.0f64;
            for slot in &mut *slots {
                let (axes, arm, center) = (slot.axes(), held.arm(slot), held.center(&slot.plane));
                let response = axes * (slot.compliance() + held.response(&arm)) * axes.transpose();
                let mut others = total;
                others.add(&-axes.tr_mul(&slot.force), &arm);
                let free_center = center + held.give(&others, &arm);
                let gap = slot.gap(&free_center, ball.radius, age) + slot.lag;
                let anchor = slot.anchor.unwrap_or(center);
                let along = axes * (free_center - anchor);
                let free = Vector3::new(gap, along[1], along[2]);
                let (mut force, _) = contact_force(&response, &free, slot.plane.friction, &slot.force);
                let most = slot.leaves.map_or(f64::INFINITY, |force| force * (1.0 - share));
                if force.x > most {
                    force *= most / force.x;
                }
                moved = moved.max((force - slot.force).norm());
                slot.force = force;
                total = others;
                total.add(&axes.tr_mul(&force), &arm);
            }
            if moved < 1e-9 {
                break;
            }
        }
        let pushed: f64 = slots.iter().map(|slot| slot.force.x.max(0.0)).sum();
        for slot in slots {
            if slot.force.x <= 0.0 {
                (slot.anchor, slot.force) = (None, Vector3::zeros());
                continue;
            }
            self.touches = true;
            let (axes, arm, center) = (slot.axes(), held.arm(slot), held.center(&slot.plane));
            let at = center + held.give(&total, &arm);
            let force = axes.tr_mul(&slot.force);
            let dent = slot.compliance() * force;
            if slot.leaves.is_some() {
                slot.lag = -(slot.gap(&at, held.radius, age) + slot.normal.dot(&dent));
            }
            let across = slot.force.y.hypot(slot.force.z);
            let most = slot.plane.friction * slot.force.x;
            let sticks = across < most * (1.0 - 1e-9);
            // A contact that slides takes its anchor along. What sticks is held across the normal.
            let free = at + dent;
            let anchor = slot.anchor.filter(|_| sticks).unwrap_or(free);
            if !sticks {
                slot.drift = Vector3::zeros();
            }
            slot.anchor = Some(anchor + slot.normal * slot.normal.dot(&(free - anchor)));
            out.stored += 0.5 * force.dot(&dent);
            // The damper is in series with the dent as the spring is. It never pushes harder than
            // the spring, so that neither the first touch nor the last is an impulse, and it stays
            // in the cone.
            let give = (slot.compliance() + held.response(&arm)) * slot.normal;
            // Beside others it has a share of the damper.
            let damping = slot.force.x / pushed * ball.relaxation / slot.normal.dot(&give);
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
            let whole = axes.tr_mul(&(across + Vector3::x() * normal));
            out.elastic += force;
            out.damping += whole - force;
            if turning > 0.0 {
                // Nothing turns a ball.
                out.torque += arm.cross(&whole);
            }
        }
        out.stored += 0.5 * soft * total.force.norm_squared() + 0.5 * turning * total.torque.norm_squared();
        out
    }
}

/// The old slot of each plane in which the tool is: one that pushes, of the same body or obstacle,
/// at which the tool's surface touches nearest to where it touches the plane, less than a radius
/// away. In a groove one place of the tool touches both sides, and a plane does not go on with the
/// force of another side.
fn matches(old: &[TouchSlot], planes: &[TouchPlane], held: &Held) -> [Option<usize>; MAX_PLANES] {
    let between = |a: [f64; 3], b: Vector3<f64>| (Vector3::from(a) - b).norm();
    let mut apart = [[f64::INFINITY; SLOTS]; MAX_PLANES];
    for (row, plane) in apart.iter_mut().zip(planes) {
        let normal = Vector3::from(plane.normal);
        if normal.dot(&(held.center(plane) - Vector3::from(plane.point))) >= held.radius {
            continue;
        }
        let pushes = |slot: &TouchSlot| slot.plane.key == plane.key && slot.force.x > 0.0;
        for (apart, slot) in row.iter_mut().zip(old).filter(|(_, slot)| pushes(slot)) {
            let way = between(plane.spot, slot.plane.spot.into())
                + held.radius * between(plane.normal, slot.normal);
            if way < held.radius {
                *apart = way;
            }
        }
    }
    let mut of = [None; MAX_PLANES];
    loop {
        let all = apart
            .iter()
            .enumerate()
            .flat_map(|(new, row)| row.iter().enumerate().map(move |(known, apart)| (*apart, new, known)));
        let nearest = all.min_by(|a, b| a.0.total_cmp(&b.0)).filter(|nearest| nearest.0 < f64::INFINITY);
        let Some((_, new, known)) = nearest else { return of };
        of[new] = Some(known);
        apart[new] = [f64::INFINITY; SLOTS];
        apart.iter_mut().for_each(|row| row[known] = f64::INFINITY);
    }
}

/// Time for which a plane goes on with its velocity, and in which it is corrected, s.
fn interval(model: &LocalModel) -> f64 {
    let interval = if model.interval > 0.0 { model.interval } else { model.period };
    interval.clamp(0.0, LONGEST)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ToolMap, TouchBall};

    /// A ball that sticks does not rub when the hand turns.
    #[test]
    fn a_ball_does_not_turn() {
        let ball = TouchBall { radius: 0.01, stiffness: 500.0, relaxation: 0.0, lever: 0.0 };
        let mut model = LocalModel { ball, interval: 0.01, plane_count: 1, ..LocalModel::default() };
        model.planes[0] = TouchPlane { normal: [0.0, 1.0, 0.0], friction: 0.5, ..TouchPlane::default() };
        let (mut touch, mut tool) = (Touch::default(), Tool::new(ToolMap::default()));
        for tick in 0..200 {
            model.tick = 1 + tick / 10;
            let turn = UnitQuaternion::from_scaled_axis(Vector3::x() * (1e-3 * tick as f64));
            tool.update(Vector3::y() * 0.006, Vector3::zeros(), turn, 0, false);
            let forces = touch.forces(1e-3 * tick as f64, 1e-3, &tool, &model);
            assert!(forces.elastic.xz().norm() < 1e-9, "{}", forces.elastic);
        }
    }

    /// Largest change of the force in a period and the largest force, N, of a tool that is drawn
    /// over what alternates between two planes. An update comes every 10 periods.
    fn alternates(planes: [TouchPlane; 2], turns: bool) -> [f64; 2] {
        let lever = if turns { 0.02 } else { 0.0 };
        let ball = TouchBall { radius: 0.01, stiffness: 500.0, relaxation: 0.0, lever };
        let mut model = LocalModel { ball, interval: 0.01, plane_count: 1, ..LocalModel::default() };
        let (mut touch, mut tool) = (Touch::default(), Tool::new(ToolMap::default()));
        let (mut last, mut change, mut most) = (Vector3::zeros(), 0.0f64, 0.0f64);
        for tick in 0..400 {
            model.tick = 1 + tick / 10;
            model.planes[0] = planes[model.tick as usize % 2];
            let at = Vector3::new(1e-5 * tick as f64, 0.01 - 1e-5 * (tick as f64).min(300.0), 0.0);
            tool.update(at, Vector3::zeros(), UnitQuaternion::identity(), 0, false);
            let now = touch.forces(1e-3 * tick as f64, 1e-3, &tool, &model).elastic;
            (change, most) = (change.max((now - last).norm()), most.max(now.norm()));
            last = now;
        }
        [change, most]
    }

    /// A surface that is four times as soft in each second update and turned by half a right angle,
    /// and one that touches each end of a tool in turn.
    #[test]
    fn another_plane_takes_an_update_to_take_over() {
        let soft = |give: f64| [[give, 0.0, 0.0], [0.0, give, 0.0], [0.0, 0.0, give]];
        let (sin, cos) = std::f64::consts::FRAC_PI_4.sin_cos();
        let [from, to] = [([0.0, 1.0, 0.0], 1e-3), ([sin, cos, 0.0], 4e-3)]
            .map(|(normal, give)| TouchPlane { normal, compliance: soft(give), ..TouchPlane::default() });
        let ends = [-0.02, 0.02].map(|x| TouchPlane { spot: [x, 0.0, 0.0], ..from });
        for friction in [0.0, 0.5] {
            for (planes, turns) in [([from, to], false), (ends, true)] {
                let planes = planes.map(|plane| TouchPlane { friction, ..plane });
                let [change, most] = alternates(planes, turns);
                assert!(most > 0.3 && change < 0.2 * most, "{change} N of {most} N, friction {friction}");
            }
        }
    }

    /// A capsule above a floor, led down: the force and the torque are those of its two springs,
    /// with one end on the floor and with both.
    #[test]
    fn a_capsule_on_a_floor_has_the_force_and_the_torque_of_its_springs() {
        let (stiffness, half, radius, tilt) = (500.0, 0.02, 0.01, 0.1f64);
        let ball = TouchBall { radius, stiffness, relaxation: 0.0, lever: half };
        let mut model = LocalModel { ball, interval: 0.01, plane_count: 2, ..LocalModel::default() };
        for (plane, side) in model.planes.iter_mut().zip([-half, half]) {
            *plane = TouchPlane { spot: [side, 0.0, 0.0], normal: [0.0, 1.0, 0.0], ..TouchPlane::default() };
        }
        let (mut touch, mut tool) = (Touch::default(), Tool::new(ToolMap::default()));
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * tilt);
        for (height, lies) in [(radius + 0.5 * half * tilt, false), (radius - 0.006, true)] {
            let mut forces = TouchForces::default();
            for tick in 0..400 {
                model.tick = 1 + tick / 10;
                let at = Vector3::y() * height;
                tool.update(at, Vector3::zeros(), turn, 0, false);
                forces = touch.forces(1e-3 * tick as f64, 1e-3, &tool, &model);
            }
            let push = (radius - height) * stiffness;
            // The lower end, `F = k (r + l sin tilt + l turn - y)`, `turn = -F cos tilt / (k l)`.
            let one = (push + stiffness * half * tilt.sin()) / (1.0 + tilt.cos() * tilt.cos());
            let (force, torque) = if lies {
                (push, -stiffness * half * half * tilt.tan())
            } else {
                (one, -one * half * tilt.cos())
            };
            assert!((forces.elastic.y / force - 1.0).abs() < 1e-3, "{} of {force}", forces.elastic);
            assert!((forces.torque.z / torque - 1.0).abs() < 1e-2, "{} of {torque}", forces.torque);
        }
        // What the simulation touches no more lets go within an update, and not at once.
        let before = touch.forces(0.4, 1e-3, &tool, &model).elastic.y;
        (model.tick, model.plane_count) = (100, 0);
        let mut last = before;
        for tick in 0..12 {
            let now = touch.forces(0.4 + 1e-3 * f64::from(tick), 1e-3, &tool, &model).elastic.y;
            assert!(now <= last + 1e-9 && last - now < 0.25 * before, "{now} N after {last} of {before}");
            last = now;
        }
        assert!(last.abs() < 1e-9, "{last}");
    }
}

//! Rigid bodies of another engine that touch soft ones: weight at all ratios of the masses.

use std::sync::Arc;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Cuboid, Damping, Frame, Islands, ModalModel, Moving, ObstacleShape, Plane, Rigid,
    StepError, StepSettings, Support, SurfacePoint, Together,
};

const GRAVITY: f64 = 9.81;
const RATE: f64 = 60.0;
/// Edge of the soft cube, m.
const EDGE: f64 = 0.2;

fn cube(young: f64) -> Arc<ModalModel> {
    let mut mesh = shapes::bar([4, 4, 4], [EDGE; 3]).unwrap();
    mesh.nodes.iter_mut().flatten().for_each(|x| *x -= 0.5 * EDGE);
    let damping = Damping::Ratio(0.1);
    let config = BakeConfig { modes: 20, young, damping, ..BakeConfig::linear() };
    Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
}

/// A box that a simple engine moves: it applies what a step tells, as the step expects.
#[derive(Debug, Clone)]
pub(crate) struct Crate {
    half: Vector3<f64>,
    mass: f64,
    pub(crate) center: Vector3<f64>,
    turn: UnitQuaternion<f64>,
    velocity: Vector3<f64>,
    spin: Vector3<f64>,
}

/// The shape of a crate at the end of a step without forces.
#[derive(Debug)]
struct Shape(Moving<Cuboid>);

pub(crate) const KEY: [u64; 2] = [7, 0];

impl ObstacleShape for Shape {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        self.0.at(point)
    }

    fn velocity(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.0.velocity(point)
    }

    fn check(&self) -> Result<(), StepError> {
        self.0.check()
    }

    fn rigid(&self) -> Option<[u64; 2]> {
        Some(KEY)
    }
}

impl Crate {
    pub(crate) fn new(half: [f64; 3], mass: f64, center: [f64; 3]) -> Self {
        let (velocity, spin) = (Vector3::zeros(), Vector3::zeros());
        let turn = UnitQuaternion::identity();
        Self { half: half.into(), mass, center: center.into(), turn, velocity, spin }
    }

    fn inverse_inertia(&self) -> Matrix3<f64> {
        let sides = self.half.component_mul(&self.half);
        let own = Matrix3::from_diagonal(&sides.map(|side| 3.0 / (self.mass * (sides.sum() - side))));
        let turn = self.turn.to_rotation_matrix();
        turn * own * turn.transpose()
    }

    /// From the center to a corner, world axes.
    fn arm(&self, corner: usize) -> Vector3<f64> {
        let sign = |bit: usize| if corner >> bit & 1 == 1 { 1.0 } else { -1.0 };
        self.turn * Vector3::new(sign(0), sign(1), sign(2)).component_mul(&self.half)
    }

    /// Takes back a fifth of what corners have sunk into the floor, as rigid engines do.
    fn push_out(&mut self) {
        for corner in 0..8 {
            let arm = self.arm(corner);
            let lever = arm.cross(&Vector3::y());
            let turned = self.inverse_inertia() * lever;
            let light = 1.0 / self.mass + lever.dot(&turned);
            let push = 0.2 * (-self.center.y - arm.y).max(0.0) / light;
            self.center.y += push / self.mass;
            self.turn = UnitQuaternion::from_scaled_axis(push * turned) * self.turn;
        }
    }

    fn shape(&self, h: f64) -> Arc<dyn ObstacleShape> {
        let rotation = [0.0, 0.0, 0.0, 1.0];
        let shape = Cuboid { center: [0.0; 3], rotation, half: self.half.into(), round: 0.0 };
        let turn = UnitQuaternion::from_scaled_axis(h * self.spin) * self.turn;
        Arc::new(Shape(Moving {
            shape,
            position: (self.center + h * self.velocity).into(),
            rotation: [turn.i, turn.j, turn.k, turn.w],
            velocity: self.velocity.into(),
            angular_velocity: self.spin.into(),
        }))
    }

    pub(crate) fn rigid(&self, ground: bool, forces: &[f64]) -> Rigid {
        let inverse = self.inverse_inertia();
        let mut supports = Vec::new();
        for corner in 0..8 {
            let point = self.center + self.arm(corner);
            if ground && point.y < 0.01 {
                let (normal, velocity) = ([0.0, 1.0, 0.0], [0.0; 3]);
                let gap = point.y;
                supports.push(Support {
                    other: None,
                    point: point.into(),
                    normal,
                    gap,
                    friction: 0.5,
                    velocity,
                    force: forces.get(supports.len()).copied().unwrap_or(0.0),
                });
            }
        }
        Rigid {
            key: KEY,
            center: self.center.into(),
            rotation: [self.turn.i, self.turn.j, self.turn.k, self.turn.w],
            velocity: self.velocity.into(),
            angular_velocity: self.spin.into(),
            acceleration: [0.0, -GRAVITY, 0.0],
            inverse_mass: [1.0 / self.mass; 3],
            inverse_inertia: std::array::from_fn(|i| std::array::from_fn(|j| inverse[(i, j)])),
            supports,
            ..Rigid::default()
        }
    }

    pub(crate) fn advance(&mut self, told: &Rigid, h: f64) {
        if told.force == [0.0; 3] && !told.supports.is_empty() {
            // The step says nothing of what only stands on the floor.
            return;
        }
        let mut force = Vector3::from(told.force);
        let mut torque = Vector3::from(told.torque);
        let (mut pressed, mut middle) = (0.0, Vector3::zeros());
        for support in &told.supports {
            let pull = support.force * Vector3::from(support.normal);
            pressed += support.force;
            middle += support.force * (Vector3::from(support.point) - self.center);
            force += pull;
            torque += (Vector3::from(support.point) - self.center).cross(&pull);
        }
        if !told.supports.is_empty() {
            // Friction of the floor, which a step does not tell.
            let momentum = self.velocity * self.mass / h;
            let rub = -Vector3::new(force.x + momentum.x, 0.0, force.z + momentum.z);
            let rub = rub.cap_magnitude(0.5 * pressed);
            force += rub;
            torque += (middle / pressed.max(1e-9)).cross(&rub);
            torque.y = 0.0;
        }
        let pushed = force / self.mass - Vector3::new(0.0, GRAVITY, 0.0);
        let turned = self.inverse_inertia() * torque;
        self.center += h * self.velocity + told.weight * h * h * pushed;
        let turn = h * self.spin + told.weight * h * h * turned;
        self.turn = UnitQuaternion::from_scaled_axis(turn) * self.turn;
        self.velocity += h * pushed;
        self.spin += h * turned;
        if !told.supports.is_empty() {
            self.push_out();
        }
    }
}

/// A soft cube whose center is at a height, and a crate.
struct Scene {
    model: Arc<ModalModel>,
    body: Body,
    rigid: Crate,
    islands: Islands,
    /// Whether the crate stands on the floor `y = 0`. The cube stands on it otherwise.
    below: bool,
    guarded: usize,
    most_rounds: usize,
}

impl Scene {
    fn new(young: f64, ratio: f64, below: bool) -> Self {
        let model = cube(young);
        let settings = StepSettings { gravity: [0.0, -GRAVITY, 0.0], ..Default::default() };
        let config = BodyConfig { step: 1.0 / RATE, ..settings.into() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let mass = ratio * model.mass();
        let (rigid, height) = if below {
            (Crate::new([0.25, 0.15, 0.25], mass, [0.0, 0.15, 0.0]), 0.3 + 0.5 * EDGE + 0.001)
        } else {
            (Crate::new([0.1, 0.05, 0.1], mass, [0.0, EDGE + 0.051, 0.0]), 0.5 * EDGE)
        };
        let mut state = body.state().clone();
        let at = [0.01, height, 0.02];
        state.frame = Frame::from_motion(&model, at, [0.0, 0.0, 0.0, 1.0], [0.0; 3], [0.0; 3]).unwrap();
        body.set_state(&state).unwrap();
        Self { model, body, rigid, islands: Islands::default(), below, guarded: 0, most_rounds: 0 }
    }

    fn step(&mut self) {
        let h = 1.0 / RATE;
        let mut obstacles: Vec<Arc<dyn ObstacleShape>> = vec![self.rigid.shape(h)];
        if !self.below {
            obstacles.push(Arc::new(Plane::GROUND));
        }
        self.body.set_obstacles(obstacles).unwrap();
        let forces = self.islands.rigids.first().map_or(&[][..], |told| &told.supports);
        let forces: Vec<f64> = forces.iter().map(|support| support.force).collect();
        self.islands.rigids = vec![self.rigid.rigid(self.below, &forces)];
        let mut all = [Together::new(1, &mut self.body)];
        self.islands.step_with(&mut all, &mut [], h, |_, _| true, |_, _| true);
        assert!(all[0].error.is_none(), "{:?}", all[0].error);
        let report = self.body.contacts().report();
        self.guarded += usize::from(report.guarded);
        self.most_rounds = self.most_rounds.max(report.rounds);
        let told = self.islands.rigids[0].clone();
        self.rigid.advance(&told, h);
    }

    /// Force between cube and crate, N, upward on the upper one.
    fn force(&self) -> f64 {
        self.islands.rigids[0].force[1].abs()
    }
}

#[test]
fn at_all_ratios_of_the_masses_what_lies_above_presses_with_its_weight() {
    let mut failed = Vec::new();
    for (young, below) in [(1e6, false), (1e7, false), (1e8, false), (1e6, true), (1e8, true)] {
        for ratio in [0.01, 0.1, 1.0, 10.0, 100.0] {
            let mut scene = Scene::new(young, ratio, below);
            // A column as wide as high resists a turn of its top with `E I / L`. The crate's
            // center, 0.05 m above it, goes aside by 0.15 m times that turn: what is heavier
            // topples.
            let topples = scene.rigid.mass * GRAVITY * (0.5 * EDGE + 0.05) > young * EDGE.powi(3) / 12.0;
            if !below && topples {
                println!("E {young:.0e} ratio {ratio}: the column would topple");
                continue;
            }
            (0..(8.0 * RATE) as usize).for_each(|_| scene.step());
            let (mut force, mut speed) = (0.0, 0.0f64);
            for _ in 0..60 {
                scene.step();
                force += scene.force() / 60.0;
                speed = speed.max(scene.rigid.velocity.norm());
            }
            let mass = if below { scene.model.mass() } else { scene.rigid.mass };
            let off = force / (mass * GRAVITY) - 1.0;
            let deep = scene.body.contacts().report().penetration / scene.model.size();
            println!(
                "E {young:.0e} {} ratio {ratio}: force off by {off:.1e}, {speed:.1e} m/s, {deep:.1e} deep, guarded {}, rounds {}, crate at {:.4?}, cube at {:.4?}",
                if below { "above" } else { "below" },
                scene.guarded,
                scene.most_rounds,
                scene.rigid.center.as_slice(),
                scene.body.frame().center(),
            );
            if !(off.abs() < 1e-3 && speed < 1e-3) {
                failed.push((young, below, ratio));
            }
        }
    }
    assert!(failed.is_empty(), "{failed:?}");
}

/// A cube that lies on the floor, and has done so for two seconds.
fn settled(model: &Arc<ModalModel>, x: f64) -> Body {
    let settings = StepSettings { gravity: [0.0, -GRAVITY, 0.0], ..Default::default() };
    let config = BodyConfig { step: 1.0 / RATE, ..settings.into() };
    let mut body = Body::new(model.clone(), config).unwrap();
    let mut state = body.state().clone();
    let at = [x, 0.5 * EDGE, 0.0];
    state.frame = Frame::from_motion(model, at, [0.0, 0.0, 0.0, 1.0], [0.0; 3], [0.0; 3]).unwrap();
    body.set_state(&state).unwrap();
    body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
    for _ in 0..120 {
        body.step().unwrap();
    }
    body
}

/// What becomes of a cube that rests beside, below or in the way of a crate, and of one that rests
/// far away.
#[test]
fn a_crate_wakes_the_bodies_that_it_touches_or_comes_to_and_no_others() {
    let model = cube(1e6);
    let h = 1.0 / RATE;
    // Center and velocity of a crate that is 0.2 m long, whether it sleeps, and who wakes.
    let cases = [
        ("passes beside", [0.26, 0.2, 0.0], [0.0, 0.0, 2.0], false, false),
        ("stands beside", [0.22, 0.05, 0.0], [0.0; 3], false, false),
        ("lies on it", [0.0, 0.25 - 1e-4, 0.0], [0.0; 3], false, true),
        ("sleeps on it", [0.0, 0.25 - 1e-4, 0.0], [0.0; 3], true, false),
        ("comes to it", [0.23, 0.05, 0.0], [-2.0, 0.0, 0.0], false, true),
    ];
    for (name, center, velocity, rests, wakes) in cases {
        let mut rigid = Crate::new([0.1, 0.05, 0.1], 1.0, center);
        rigid.velocity = velocity.into();
        let mut bodies = [settled(&model, 0.0), settled(&model, 5.0)];
        for body in &mut bodies {
            body.set_obstacles(vec![Arc::new(Plane::GROUND), rigid.shape(h)]).unwrap();
        }
        let before = bodies[0].state().clone();
        let mut islands = Islands::default();
        islands.rigids = vec![Rigid { rests, ..rigid.rigid(false, &[]) }];
        let mut all: Vec<_> =
            bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
        all.iter_mut().for_each(|together| together.resting = true);
        islands.step_with(&mut all, &mut [], h, |_, _| true, |_, _| true);
        let rest: Vec<bool> = all.iter().map(|together| together.resting).collect();
        println!("a crate {name}: {rest:?}");
        assert_eq!(rest, [!wakes, true], "a crate {name}");
        assert_eq!(*bodies[0].state() == before, !wakes, "a crate {name}");
    }
}

//! Contacts with known answers: their errors, and what a step of each costs.

use std::{fmt::Write, sync::Arc, time::Instant};

use nalgebra::Vector3;
use pliant_bake::BakeConfig;
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Damping, Frame, Islands, Material, ModalModel, ObstacleShape, Plane, StepSettings,
    Together,
};

use super::{
    plot::{Axes, Figure, Series},
    work::baked,
};
use crate::{LabError, machine::Pinned};

const GRAVITY: f64 = 9.81;
/// Edge of the cubes and radius of the balls, m.
const SIZE: f64 = 0.1;
const FRICTION: f64 = 0.5;

/// A case with a known answer.
struct Answer {
    case: String,
    /// Where the answer is from.
    by: &'static str,
    unit: &'static str,
    want: f64,
    got: f64,
    /// How far it may be off, as a share of the answer, or in the unit where the answer is 0.
    allowed: f64,
    /// Median time of a step that touches, us.
    us: f64,
}

impl Answer {
    fn off(&self) -> f64 {
        if self.want == 0.0 { self.got.abs() } else { (self.got / self.want - 1.0).abs() }
    }
}

fn model(mesh: &TetMesh, young: f64, change: impl Fn(&mut BakeConfig)) -> Result<Arc<ModalModel>, LabError> {
    let mut config = BakeConfig { modes: 30, young, poisson: 0.3, sites: Some(100), ..BakeConfig::linear() };
    change(&mut config);
    Ok(baked(mesh, &config)?.0)
}

/// Bodies that lie or fall on the plane `y = 0`.
struct Scene {
    bodies: Vec<Body>,
    islands: Islands,
    /// Times of the steps in which something touched, us.
    us: Vec<f64>,
}

/// How a body begins: steps a second, gravity (m/s^2), friction, gap under its lowest point (m) and
/// velocity (m/s).
#[derive(Clone, Copy)]
struct Begin {
    rate: f64,
    gravity: [f64; 3],
    friction: f64,
    gap: f64,
    velocity: [f64; 3],
}

/// At 60 steps a second, in gravity that is tilted as a slope would be.
fn on_slope(tangent: f64) -> Begin {
    let angle = tangent.atan();
    let gravity = [GRAVITY * angle.sin(), -GRAVITY * angle.cos(), 0.0];
    Begin { rate: 60.0, gravity, friction: FRICTION, gap: 0.0, velocity: [0.0; 3] }
}

impl Scene {
    fn new(model: &Arc<ModalModel>, begin: Begin) -> Result<Self, LabError> {
        let mut scene = Self { bodies: Vec::new(), islands: Islands::default(), us: Vec::new() };
        scene.add(model, begin)?;
        Ok(scene)
    }

    fn add(&mut self, model: &Arc<ModalModel>, begin: Begin) -> Result<(), LabError> {
        let settings = StepSettings { gravity: begin.gravity, ..StepSettings::default() };
        let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / begin.rate, ..settings.into() })?;
        body.set_friction(begin.friction)?;
        let ground: Arc<dyn ObstacleShape> = Arc::new(Plane::GROUND);
        body.set_obstacles(vec![ground])?;
        let mut state = body.state().clone();
        let mut center = state.frame.center();
        center[1] += begin.gap - f64::from(model.surface().bounds()[0][1]);
        state.frame = Frame::from_motion(model, center, [0.0, 0.0, 0.0, 1.0], begin.velocity, [0.0; 3])?;
        body.set_state(&state)?;
        self.bodies.push(body);
        Ok(())
    }

    fn step(&mut self) -> Result<(), LabError> {
        let mut all: Vec<Together<'_>> =
            self.bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
        let begun = Instant::now();
        self.islands.step(&mut all, |_, _| true);
        let taken = begun.elapsed().as_secs_f64() * 1e6;
        let touches = all.iter().any(|together| !together.body.contacts().contacts().is_empty());
        if touches {
            self.us.push(taken);
        }
        match all.into_iter().find_map(|together| together.error) {
            Some(error) => Err(error.into()),
            None => Ok(()),
        }
    }

    fn run(&mut self, seconds: f64) -> Result<(), LabError> {
        let step = self.body().config().step;
        (0..(seconds / step).round() as usize).try_for_each(|_| self.step())
    }

    fn body(&self) -> &Body {
        &self.bodies[0]
    }

    fn center(&self) -> Vector3<f64> {
        self.body().frame().center().into()
    }

    fn pushed(&self) -> f64 {
        self.body().contacts().report().force[1]
    }

    fn us(&self) -> f64 {
        let mut sorted = self.us.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }
}

fn resting(out: &mut Vec<Answer>, seconds: f64) -> Result<(), LabError> {
    let cube = model(&shapes::cube(4, SIZE)?, 1e5, |_| ())?;
    let weight = cube.mass() * GRAVITY;
    let mut scene = Scene::new(&cube, on_slope(0.0))?;
    scene.run(5.0)?;
    let (force, deep) = (scene.pushed(), scene.body().contacts().report().penetration);
    let mut add = |case: &str, by, unit, want, got, allowed, us| {
        out.push(Answer { case: case.to_owned(), by, unit, want, got, allowed, us });
    };
    add("a cube at rest: force of the floor", "its weight", "N", weight, force, 1e-6, scene.us());
    add("the same: depth / size", "no penetration", "-", 0.0, deep / cube.size(), 2e-3, scene.us());
    let mut scene = Scene::new(&cube, on_slope(0.99 * FRICTION))?;
    scene.run(5.0)?;
    let before = scene.center();
    scene.run(seconds)?;
    let crept = (scene.center() - before).norm() / cube.size() * 60.0 / seconds;
    add("on a slope of 0.99 mu: creep a minute / size", "Coulomb", "-", 0.0, crept, 1e-4, scene.us());
    for share in [1.01, 1.1, 2.0] {
        let mut scene = Scene::new(&cube, on_slope(share * FRICTION))?;
        scene.run(1.0)?;
        let before = scene.body().frame().velocity()[0];
        scene.run(1.0)?;
        let got = scene.body().frame().velocity()[0] - before;
        let angle = (share * FRICTION).atan();
        let want = GRAVITY * (angle.sin() - FRICTION * angle.cos());
        let case = format!("on a slope of {share} mu: acceleration");
        add(&case, "g (sin - mu cos)", "m/s^2", want, got, 0.01, scene.us());
    }
    let ball = model(&shapes::sphere(8, SIZE)?, 1e7, |config| config.sites = None)?;
    let velocity = [1.0, 0.0, 0.0];
    let mut scene = Scene::new(&ball, Begin { rate: 240.0, friction: 0.3, velocity, ..on_slope(0.0) })?;
    // It slides for 2 v / (7 mu g).
    scene.run(1.5 * 2.0 / (7.0 * 0.3 * GRAVITY))?;
    let speed = scene.body().frame().velocity()[0];
    add("a ball that slid at 1 m/s rolls", "5/7 of its speed", "m/s", 5.0 / 7.0, speed, 0.01, scene.us());
    let stiff = model(&shapes::cube(4, SIZE)?, 1e6, |_| ())?;
    let mut scene = Scene::new(&stiff, on_slope(0.0))?;
    for level in 1..5 {
        scene.add(&stiff, Begin { gap: SIZE * f64::from(level), ..on_slope(0.0) })?;
    }
    scene.run(10.0)?;
    let ground = scene.bodies[0].contacts().contacts().iter();
    let carried: f64 = ground.map(|contact| contact.force[1].max(0.0)).sum();
    let weight = 5.0 * stiff.mass() * GRAVITY;
    add("a stack of five cubes: force of the floor", "their weight", "N", weight, carried, 1e-6, scene.us());
    let mut scene = Scene::new(&cube, Begin { gravity: [0.0; 3], rate: 240.0, gap: 1.0, ..on_slope(0.0) })?;
    let at = |x: f64, speed: f64, spin: [f64; 3]| {
        Frame::from_motion(&cube, [x, 1.0, 0.0], [0.2, -0.1, 0.3, 0.9], [speed, 0.1, 0.0], spin)
    };
    scene.add(&cube, Begin { gravity: [0.0; 3], rate: 240.0, gap: 1.0, ..on_slope(0.0) })?;
    let frames = [at(0.0, 0.5, [5e-4, -1e-3, 2e-3])?, at(0.22, -0.5, [-1e-3, 3e-4, 4e-4])?];
    for (body, frame) in scene.bodies.iter_mut().zip(frames) {
        let state = pliant_modal::State { frame, ..body.state().clone() };
        body.set_state(&state)?;
    }
    let own = |scene: &Scene| -> Vec<[Vector3<f64>; 2]> {
        scene
            .bodies
            .iter()
            .map(|body| {
                let (p, l) = body.momentum();
                [p.into(), l.into()]
            })
            .collect()
    };
    let before = own(&scene);
    let (mut lost, mut most) = ([0.0f64; 2], [0.0f64; 2]);
    for _ in 0..120 {
        scene.step()?;
        let now = own(&scene);
        for k in 0..2 {
            most[k] = most[k].max((now[0][k] - before[0][k]).norm());
            lost[k] = lost[k].max((now[0][k] + now[1][k] - before[0][k] - before[1][k]).norm());
        }
    }
    add("two cubes meet: momentum lost / exchanged", "Newton", "-", 0.0, lost[0] / most[0], 1e-6, scene.us());
    add("the same: angular momentum", "Newton", "-", 0.0, lost[1] / most[1], 1e-6, scene.us());
    Ok(())
}

/// Balls that are pressed on a plane by a force, against H. Hertz, *Ueber die Beruehrung fester
/// elastischer Koerper* (1881): `F = 4/3 E* sqrt(R) d^1.5`.
fn pressed(out: &mut Vec<Answer>) -> Result<(), LabError> {
    let plain = 1e5 / (1.0 - 0.3f64.powi(2));
    for (name, material) in [("linear", None), ("reduced", Some(Material::NeoHookean))] {
        let change = |config: &mut BakeConfig| (config.material, config.sites) = (material, None);
        let ball = model(&shapes::sphere(8, SIZE)?, 1e5, change)?;
        for share in [0.1, 0.2, 0.3f64] {
            let depth = share * share * SIZE;
            let force = 4.0 / 3.0 * plain * SIZE.sqrt() * depth.powf(1.5);
            let gravity = [0.0, -force / ball.mass(), 0.0];
            let mut scene = Scene::new(&ball, Begin { gravity, friction: 0.0, ..on_slope(0.0) })?;
            for body in &mut scene.bodies {
                let mut config = body.config().clone();
                config.settings.damping_scale = 20.0;
                body.reconfigure(config)?;
            }
            scene.run(10.0)?;
            let sunk = SIZE - scene.center().y;
            let got = 4.0 / 3.0 * plain * SIZE.sqrt() * sunk.max(0.0).powf(1.5);
            out.push(Answer {
                case: format!("a pressed ball, {name}, a/R = {share}: Hertz's force at its depth"),
                by: "the force that presses",
                unit: "N",
                want: force,
                got,
                allowed: if share < 0.15 { 0.05 } else { 0.13 },
                us: scene.us(),
            });
        }
    }
    Ok(())
}

/// What an impact does: the time and the force as shares of the closed form, the speed that is
/// kept, and the times of a step that touches and of all of these, us.
struct Impact {
    time: f64,
    force: f64,
    kept: f64,
    us: f64,
    whole_us: f64,
}

/// An impact of a body on the plane, with `steps` in the time of the closed form.
fn impact(
    model: &Arc<ModalModel>,
    [time, force, speed]: [f64; 3],
    steps: f64,
    median: bool,
) -> Result<Impact, LabError> {
    let (rate, velocity) = (steps / time, [0.0, -speed, 0.0]);
    // It touches in the middle of a step.
    let gap = 1.5 * speed / rate;
    let begin = Begin { rate, gravity: [0.0; 3], friction: 0.0, gap, velocity };
    let mut scene = Scene::new(model, begin)?;
    let mut forces = Vec::new();
    for _ in 0..(3.0 * steps) as usize {
        scene.step()?;
        if scene.pushed() > 0.0 {
            forces.push(scene.pushed());
        }
    }
    let lasted = forces.len() as f64 / steps;
    forces.sort_by(f64::total_cmp);
    let got = if median { forces.get(forces.len() / 2) } else { forces.last() };
    Ok(Impact {
        time: lasted,
        force: got.copied().unwrap_or(f64::NAN) / force,
        kept: scene.body().frame().velocity()[1] / speed,
        us: scene.us(),
        whole_us: scene.us.iter().sum(),
    })
}

/// The known answers of contact, and the errors of impacts against their cost.
pub(super) fn contact(quick: bool) -> Result<(Vec<Figure>, String), LabError> {
    let _pinned = Pinned::new();
    let mut answers = Vec::new();
    resting(&mut answers, if quick { 5.0 } else { 60.0 })?;
    pressed(&mut answers)?;
    // A ball after Hertz.
    let (young, speed) = (1e6, 0.2);
    let undamped = |config: &mut BakeConfig| config.damping = Damping::Ratio(0.0);
    let ball = model(&shapes::sphere(if quick { 8 } else { 14 }, SIZE)?, young, |config| {
        undamped(config);
        (config.modes, config.sites) = (60, None);
    })?;
    let (mass, plain) = (ball.mass(), young / (1.0 - 0.3f64.powi(2)));
    let time = 2.87 * (mass * mass / (SIZE * plain * plain * speed)).powf(0.2);
    let depth = (15.0 * mass * speed * speed / (16.0 * SIZE.sqrt() * plain)).powf(0.4);
    let force = 4.0 / 3.0 * plain * SIZE.sqrt() * depth.powf(1.5);
    // A bar whose end meets a wall: the wave goes along it and back.
    let (length, young, density, slow) = (0.8, 1e5f64, 1000.0, 0.1);
    let bar = model(&shapes::bar([2, 32, 2], [SIZE, length, SIZE])?, young, |config| {
        undamped(config);
        (config.poisson, config.density, config.modes) = (0.0, density, 60);
    })?;
    let wave = (young / density).sqrt();
    let hits = [
        ("ball", ball, [time, force, speed], false),
        ("bar", bar, [2.0 * length / wave, density * wave * SIZE * SIZE * slow, slow], true),
    ];
    let mut series = Vec::new();
    let counts: &[f64] = if quick { &[16.0, 64.0] } else { &[8.0, 16.0, 32.0, 64.0, 128.0, 256.0] };
    for (name, model, exact, median) in &hits {
        let mut lines = [const { Vec::new() }; 3];
        for &steps in counts {
            let got = impact(model, *exact, steps, *median)?;
            let cost = got.whole_us;
            for (line, off) in lines.iter_mut().zip([got.time - 1.0, got.force - 1.0, 1.0 - got.kept]) {
                line.push((cost, (100.0 * off.abs()).max(1e-3)));
            }
            if steps == 16.0 || steps == 64.0 {
                let by = if *median { "waves in a bar" } else { "Hertz" };
                let case = |what| format!("a {name} hits a wall, {steps} steps: {what}");
                let [time, force, _] = *exact;
                let all = [
                    (
                        case("time"),
                        "ms",
                        1e3 * time,
                        1e3 * time * got.time,
                        if *median { 0.13 } else { 0.07 },
                    ),
                    (case("force"), "N", force, force * got.force, if *median { 0.05 } else { 0.08 }),
                    (case("speed kept"), "-", 1.0, got.kept, if *median { 0.1 } else { 0.2 }),
                ];
                answers.extend(all.map(|(case, unit, want, got_here, allowed)| Answer {
                    case,
                    by,
                    unit,
                    want,
                    got: got_here,
                    allowed,
                    us: got.us,
                }));
            }
        }
        let names = ["time", "force", "speed lost"];
        series
            .extend(names.iter().zip(lines).map(|(what, line)| Series::new(format!("{name}: {what}"), line)));
    }
    let figure = Figure {
        file: "i-impact".into(),
        title: "Impacts against their closed forms".into(),
        x: "time of one core for the contact, us".into(),
        y: "off from the closed form, %".into(),
        axes: Axes::Logarithmic,
        series,
        reference_error: None,
        words: format!(
            "A ball ({SIZE} m, 1 MPa, {speed} m/s; Hertz, some {:.1} ms) and a bar ({length} x {SIZE} x {SIZE} m, 0.1 MPa, {slow} m/s; `2 L / c` = {:.0} ms and `rho c A v`) hit a wall with {} to {} steps in the time of the closed form. A contact begins and ends within a step, so that its time is off by up to one step. Errors below 0.001 % are drawn there. The bar's time stays some 8 % too long however short the steps are. Hertz's forms are those of a half-space without waves, and the bar's is that of one dimension with Poisson's ratio 0. The exact speed is kept whole by the bar; of the ball, waves keep less than a hundredth here.",
            1e3 * time,
            1e3 * 2.0 * length / wave,
            counts[0],
            counts[counts.len() - 1],
        ),
        below: None,
    };
    let mut text = String::from(
        "\nCases with known answers. Where the answer is zero, *off* is the value itself in %. A step is one in which something touches. The tests of the crates assert these cases and more.\n\n| case | known from | unit | exact | Pliant | off % | allowed % | a step, us |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n",
    );
    for answer in &answers {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.5} | {:.5} | {:.2e} | {:.2e} | {:.1} |",
            answer.case,
            answer.by,
            answer.unit,
            answer.want,
            answer.got,
            100.0 * answer.off(),
            100.0 * answer.allowed,
            answer.us
        );
    }
    let missed =
        answers.iter().filter(|answer| answer.off().is_nan() || answer.off() > answer.allowed).count();
    let _ = writeln!(text, "\nOf {} answers {} are farther off than is allowed.", answers.len(), missed);
    Ok((vec![figure], text))
}

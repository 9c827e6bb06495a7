//! A free body that falls onto the ground, onto a ball or onto another body.

use std::{sync::Arc, time::Instant};

use nalgebra::{UnitQuaternion, Vector3};
use pliant_modal::{
    Body, BodyConfig, Contacts, Elasticity, Islands, ModalModel, ModelError, ObstacleShape, Plane, Sphere,
    StepSettings, Together,
};
use serde::Serialize;

use crate::{
    LabError,
    bench::{Percentiles, percentiles},
    machine::Pinned,
};

/// Largest number of steps of a fall.
const MAX_TICKS: f64 = 1e7;

/// What a body falls onto.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Onto {
    /// The plane `y = 0`.
    #[default]
    Plane,
    /// A ball of this radius (m), whose highest point is at `y = 0` under the center of mass.
    Sphere(f64),
    /// A body of this model, whose highest point is at `y = 0` and whose center of mass is under
    /// that of the body that falls. Its lowest point stands on a plane, which both touch.
    Body(Arc<ModalModel>),
}

/// A fall to compute.
///
/// The body stands as its model does. Then the body and what it falls onto are turned about the z
/// axis by the tilt. Gravity always points along -y.
#[derive(Debug, Clone, PartialEq)]
pub struct Drop {
    /// Gap under the lowest point of the body, m, 0 or more. Default: 0.1.
    pub height: f64,
    /// Tilt of the ground, degrees, -89 to 89. Default: 0.
    pub tilt: f64,
    /// Coefficient of friction. Default: [`Contacts::FRICTION`].
    pub friction: f64,
    /// Gravity, m/s^2, 0 or more. Default: 9.81.
    pub gravity: f64,
    /// Duration, s. Default: 2.
    pub seconds: f64,
    /// Steps per second. Default: 60.
    pub rate: f64,
    /// What the body falls onto.
    pub onto: Onto,
    /// Elasticity of the bodies. `None`: reduced if a model has a material, linear otherwise.
    pub elasticity: Option<Elasticity>,
}

impl Default for Drop {
    fn default() -> Self {
        Self {
            height: 0.1,
            tilt: 0.0,
            friction: Contacts::FRICTION,
            gravity: 9.81,
            seconds: 2.0,
            rate: 60.0,
            onto: Onto::Plane,
            elasticity: None,
        }
    }
}

/// The body after one step. Energies include those of the body that it falls onto.
#[derive(Serialize, Debug, Clone, Copy, PartialEq, Default)]
pub struct DropTick {
    /// Time, s.
    pub time: f64,
    /// Center of mass, m, world axes.
    pub center: [f64; 3],
    /// Velocity of the center of mass, m/s, world axes.
    pub velocity: [f64; 3],
    /// Sum of the contact forces on the body over the step that ends here, N, world axes.
    pub contact_force: [f64; 3],
    /// Kinetic energy, J.
    pub kinetic: f64,
    /// Elastic energy of the body, J, with that of the dents at its contacts.
    pub elastic: f64,
    /// Potential energy in gravity, J. Zero for a center of mass at `y = 0`.
    pub potential: f64,
    /// Number of contacts with force.
    pub contacts: usize,
    /// Largest depth of the body's surface inside the obstacle, m.
    pub penetration: f64,
    /// Time that the step took, microseconds. Zero for the first tick, which is no step.
    pub step_us: f64,
}

/// What happened to a body that fell.
#[derive(Serialize, Debug, Clone)]
pub struct Dropped {
    /// Elasticity of the body.
    pub elasticity: Elasticity,
    /// Mass, kg.
    pub mass: f64,
    /// Largest extent of the body, m.
    pub size: f64,
    /// Number of contact sites of the body.
    pub sites: usize,
    /// Time of one step of all bodies on one core.
    pub step_us: Percentiles,
    /// The start and the end of every step.
    pub ticks: Vec<DropTick>,
}

impl Drop {
    fn check(&self) -> Result<(), LabError> {
        let &Self { height, tilt, gravity, seconds, rate, .. } = self;
        let number = |what, expected, sound: bool, got| {
            if sound { Ok(()) } else { Err(ModelError::Value { what, index: 0, expected, got }) }
        };
        number("height", "0 to 1e6 m", (0.0..=1e6).contains(&height), height)?;
        number("tilt", "-89 to 89 degrees", (-89.0..=89.0).contains(&tilt), tilt)?;
        number("gravity", "0 to 1e6 m/s^2", (0.0..=1e6).contains(&gravity), gravity)?;
        number("rate", "1 to 1e6 steps a second", (1.0..=1e6).contains(&rate), rate)?;
        let sound = seconds > 0.0 && seconds * rate <= MAX_TICKS;
        number("seconds", "above 0 and at most ten million steps", sound, seconds)?;
        if let Onto::Sphere(radius) = self.onto {
            number("radius of the sphere", "above 0 m, at most 1e6", radius > 0.0 && radius <= 1e6, radius)?;
        }
        Ok(())
    }
}

fn tick(bodies: &[Body], time: f64, step_us: f64) -> DropTick {
    let sum = |of: fn(&Body) -> f64| bodies.iter().map(of).sum::<f64>();
    let [body, ..] = bodies else { return DropTick { time, step_us, ..DropTick::default() } };
    let report = body.contacts().report();
    DropTick {
        time,
        center: body.frame().center(),
        velocity: body.frame().velocity(),
        contact_force: report.force,
        kinetic: sum(Body::kinetic_energy),
        elastic: sum(|body| body.energy() - body.kinetic_energy() + body.contacts().report().energy),
        potential: sum(Body::potential_energy),
        contacts: report.contacts,
        penetration: report.penetration,
        step_us,
    }
}

/// Makes a body for a fall.
fn make(model: &Arc<ModalModel>, drop: &Drop, elasticity: Option<Elasticity>) -> Result<Body, LabError> {
    let elasticity = crate::elasticity_of(model, elasticity)?;
    let settings = StepSettings { elasticity, gravity: [0.0, -drop.gravity, 0.0], ..StepSettings::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / drop.rate, ..settings.into() })?;
    body.set_friction(drop.friction)?;
    Ok(body)
}

/// Lets a free body fall.
///
/// # Errors
/// Returns [`LabError::Anchored`] for a body with anchors, [`LabError::NoMaterial`] for reduced
/// elasticity of a model that has no material, [`LabError::Model`] for a number out of its range,
/// and [`LabError::Step`] when a body cannot be stepped.
pub fn drop(model: &Arc<ModalModel>, drop: &Drop) -> Result<Dropped, LabError> {
    drop.check()?;
    if !model.is_free() {
        return Err(LabError::Anchored);
    }
    let mut body = make(model, drop, drop.elasticity)?;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), drop.tilt.to_radians());
    let normal = (turn * Vector3::y()).into();
    let [x, _, z] = model.center_of_mass();
    let [i, j, k, w] = [turn.i, turn.j, turn.k, turn.w];
    let mut under = None;
    let obstacle: Arc<dyn ObstacleShape> = match &drop.onto {
        Onto::Plane => Arc::new(Plane { point: [0.0; 3], normal }),
        Onto::Sphere(radius) => {
            Arc::new(Sphere { center: (turn * Vector3::new(x, -radius, z)).into(), radius: *radius })
        }
        Onto::Body(base) => {
            // A base without a material is linear, whatever the body that falls is.
            let elasticity = drop.elasticity.filter(|_| base.material().is_some());
            let mut base = make(base, drop, elasticity)?;
            let [low, high] = base.model().surface().bounds().map(|corner| f64::from(corner[1]));
            let [under_x, _, under_z] = base.model().center_of_mass();
            let origin = turn * Vector3::new(x - under_x, -high, z - under_z);
            base.set_pose(origin.into(), [i, j, k, w])?;
            under = Some(base);
            Arc::new(Plane { point: (turn * Vector3::new(0.0, low - high, 0.0)).into(), normal })
        }
    };
    let lowest = f64::from(model.surface().bounds()[0][1]);
    let origin = turn * Vector3::new(0.0, drop.height - lowest, 0.0);
    body.set_pose(origin.into(), [i, j, k, w])?;
    let mut bodies = vec![body];
    bodies.extend(under);
    for body in &mut bodies {
        body.set_obstacles(vec![obstacle.clone()])?;
    }
    let _pinned = Pinned::new();
    let steps = (drop.seconds * drop.rate).round().max(1.0) as usize;
    let mut ticks = Vec::with_capacity(steps + 1);
    ticks.push(tick(&bodies, 0.0, 0.0));
    let mut islands = Islands::default();
    for step in 1..=steps {
        let mut all: Vec<Together<'_>> =
            bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
        let begun = Instant::now();
        islands.step(&mut all, |_, _| true);
        let taken = begun.elapsed().as_secs_f64() * 1e6;
        if let Some(error) = all.into_iter().find_map(|together| together.error) {
            return Err(error.into());
        }
        ticks.push(tick(&bodies, step as f64 / drop.rate, taken));
    }
    let step_us = percentiles(ticks[1..].iter().map(|tick| tick.step_us).collect());
    let (elasticity, sites) = bodies
        .first()
        .map_or((Elasticity::Linear, 0), |body| (body.config().settings.elasticity, body.contacts().sites()));
    Ok(Dropped { elasticity, mass: model.mass(), size: model.size(), sites, step_us, ticks })
}

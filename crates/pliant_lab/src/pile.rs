//! Free bodies that fall onto each other on a plane.

use std::{sync::Arc, time::Instant};

use nalgebra::{UnitQuaternion, Vector3};
use pliant_modal::{
    Body, BodyConfig, Contacts, Elasticity, Islands, ModalModel, ModelError, Plane, StepSettings, Together,
};
use serde::Serialize;

use crate::{
    LabError,
    bench::{Percentiles, percentiles},
    machine::Pinned,
};

/// A pile to compute: copies of one body, which are dropped in layers of nine (three by three) onto
/// the plane `y = 0`, each turned otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pile {
    /// Number of bodies, 1 to 1000. Default: 10.
    pub count: usize,
    /// Duration, s. Default: 4.
    pub seconds: f64,
    /// Steps per second. Default: 60.
    pub rate: f64,
    /// Coefficient of friction. Default: [`Contacts::FRICTION`].
    pub friction: f64,
    /// Elasticity of the bodies. `None`: reduced if the model has a material, linear otherwise.
    pub elasticity: Option<Elasticity>,
}

impl Default for Pile {
    fn default() -> Self {
        Self { count: 10, seconds: 4.0, rate: 60.0, friction: Contacts::FRICTION, elasticity: None }
    }
}

/// What happened to a pile.
#[derive(Serialize, Debug, Clone)]
pub struct Piled {
    /// Number of bodies.
    pub bodies: usize,
    /// Number of coordinates of each body, without its frame.
    pub modes: usize,
    /// Time of a tick of all bodies on one core.
    pub tick_us: Percentiles,
    /// Time of a tick with contacts, divided by their number.
    pub contact_us: Percentiles,
    /// Largest number of contacts in a tick.
    pub contacts: usize,
    /// Number of contacts in the last tick.
    pub contacts_at_end: usize,
    /// Energy at the start, J: kinetic, elastic and that of the height above the plane.
    pub start: f64,
    /// Largest rise of the energy from one tick to the next, as a share of that at the start.
    pub gain: f64,
    /// Energy of motion at the end, J.
    pub kinetic_at_end: f64,
    /// Largest penetration of the last second, as a share of a body's size.
    pub penetration: f64,
    /// Number of steps that failed.
    pub failures: usize,
}

impl Pile {
    /// Makes the bodies of the pile above the ground, which is their only obstacle.
    ///
    /// # Errors
    /// Returns the errors of [`pile`].
    pub fn bodies(&self, model: &Arc<ModalModel>) -> Result<Vec<Body>, LabError> {
        let pile = self;
        let range = |what, expected, sound: bool, got| {
            if sound { Ok(()) } else { Err(ModelError::Value { what, index: 0, expected, got }) }
        };
        range("count", "1 to 1000 bodies", (1..=1000).contains(&pile.count), pile.count as f64)?;
        range("rate", "1 to 1e6 steps a second", (1.0..=1e6).contains(&pile.rate), pile.rate)?;
        let sound = pile.seconds > 0.0 && pile.seconds * pile.rate <= 1e6;
        range("seconds", "above 0 and at most a million steps", sound, pile.seconds)?;
        if !model.is_free() {
            return Err(LabError::Anchored);
        }
        let elasticity = crate::elasticity_of(model, pile.elasticity)?;
        let settings = StepSettings { elasticity, gravity: [0.0, -9.81, 0.0], ..StepSettings::default() };
        let config = BodyConfig { step: 1.0 / pile.rate, ..settings.into() };
        let mut bodies = Vec::with_capacity(pile.count);
        for index in 0..pile.count {
            let mut body = Body::new(model.clone(), config.clone())?;
            body.set_friction(pile.friction)?;
            body.set_obstacles(vec![Arc::new(Plane::GROUND)])?;
            let (layer, column, row) = (index / 9, index % 3, index / 3 % 3);
            // Layers are shifted, so that bodies fall between those below.
            let aside = 0.3 * f64::from(layer as u32 % 2);
            let place = Vector3::new(column as f64 + aside, 1.0 + 1.2 * layer as f64, row as f64 + aside);
            let turn =
                UnitQuaternion::from_scaled_axis(Vector3::new(0.7, 1.3, 0.4) * (0.3 * (index % 7) as f64));
            let center = Vector3::from(model.center_of_mass());
            let origin = 1.15 * model.size() * place - turn * center;
            body.set_pose(origin.into(), [turn.i, turn.j, turn.k, turn.w])?;
            bodies.push(body);
        }
        Ok(bodies)
    }
}

/// Lets bodies of a model fall onto each other.
///
/// # Errors
/// Returns [`LabError::Anchored`] for a model with anchors, [`LabError::NoMaterial`] for reduced
/// elasticity of a model that has no material, [`LabError::Model`] for a number out of its range,
/// and [`LabError::Step`] when a body cannot be made.
pub fn pile(model: &Arc<ModalModel>, pile: &Pile) -> Result<Piled, LabError> {
    let mut bodies = pile.bodies(model)?;
    let total = |bodies: &[Body]| -> f64 {
        let energy = |body: &Body| body.energy() + body.potential_energy() + body.contacts().report().energy;
        bodies.iter().map(energy).sum()
    };
    let _pinned = Pinned::new();
    let mut islands = Islands::default();
    let start = total(&bodies);
    let (mut before, mut gain, mut failures, mut most) = (start, f64::NEG_INFINITY, 0, 0);
    let (mut ticks, mut per_contact, mut penetration) = (Vec::new(), Vec::new(), 0.0f64);
    let steps = (pile.seconds * pile.rate).round().max(1.0) as usize;
    let mut contacts = 0;
    for step in 0..steps {
        let mut all: Vec<Together<'_>> =
            bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
        let begun = Instant::now();
        islands.step(&mut all, |_, _| true);
        let taken = begun.elapsed().as_secs_f64() * 1e6;
        failures += all.iter().filter(|together| together.error.is_some()).count();
        // A contact of two bodies is in both lists.
        let of_body = |body: &Body| {
            let list = body.contacts().contacts().iter();
            list.map(|contact| if matches!(contact.other, pliant_modal::Touched::Body(_)) { 1 } else { 2 })
                .sum::<usize>()
        };
        contacts = bodies.iter().map(of_body).sum::<usize>() / 2;
        most = most.max(contacts);
        ticks.push(taken);
        if contacts > 0 {
            per_contact.push(taken / contacts as f64);
        }
        let now = total(&bodies);
        gain = gain.max((now - before) / start.abs());
        before = now;
        if (steps - step) as f64 <= pile.rate {
            let deepest = bodies.iter().map(|body| body.contacts().report().penetration);
            penetration = deepest.fold(penetration, f64::max);
        }
    }
    Ok(Piled {
        bodies: pile.count,
        modes: model.mode_count(),
        tick_us: percentiles(ticks),
        contact_us: percentiles(per_contact),
        contacts: most,
        contacts_at_end: contacts,
        start,
        gain,
        kinetic_at_end: bodies.iter().map(Body::kinetic_energy).sum(),
        penetration: penetration / model.size(),
        failures,
    })
}

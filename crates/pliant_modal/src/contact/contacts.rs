//! The contacts of one copy of a body: what it may touch, and what the last step left.

use std::sync::Arc;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::{Attachment, Bent, Cloud, ContactSites, Memory, ObstacleShape, Touching};
use crate::{Hand, StepError};

/// What a body touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Touched {
    /// The obstacle at this index of the body's list.
    Obstacle(usize),
    /// The body with this key, see [`Together::key`](crate::Together::key).
    Body(u64),
    /// The [`Probe`](crate::Probe) at this index of the step's list.
    Probe(usize),
    /// What the attachment at this index of the body's list holds. No list of contacts has it: see
    /// [`Body::attachment_force`](crate::Body::attachment_force).
    Attachment(usize),
}

/// A contact of the last step that carried force.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// What the body touches.
    pub other: Touched,
    /// Surface vertex of the body at the center of the touching patch.
    pub vertex: u32,
    /// Position of the contact at the end of the step, m, world axes.
    pub point: [f64; 3],
    /// Outward normal of the obstacle or of the other body, world axes.
    pub normal: [f64; 3],
    /// Force on the body over the step, N, world axes.
    pub force: [f64; 3],
    /// Depth of the touching surface inside the other at the end of the step, m, 0 or more. The
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
    /// Energy in the residual flexibility of the body's own patches at the end of the step, J. The
    /// energy of the body does not include it.
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

/// What a contact with an obstacle leaves for the next step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ContactMemory {
    /// Index of the obstacle in the body's list.
    pub obstacle: u16,
    /// Number of the contact site.
    pub site: u16,
    /// Force on the body over the step, N, world axes.
    pub force: [f64; 3],
    /// Where the surface of the site sticks, m, world axes.
    pub anchor: [f64; 3],
    /// Direction from the center of the site to its contact point, body axes. Zero for a site that
    /// is not round.
    pub toward: [f64; 3],
    /// Energy in the dent, J, 0 or more, where the site stands for all of a part of the surface
    /// that is a part of a sphere.
    pub leads: Option<f64>,
}

impl ContactMemory {
    fn is_valid(&self) -> bool {
        let near = |x: &[f64; 3]| x.iter().all(|x| x.abs() <= ContactState::LARGEST);
        let stored = self.leads.is_none_or(|energy| (0.0..=ContactState::LARGEST).contains(&energy));
        stored && near(&self.force) && near(&self.anchor) && self.toward.iter().all(|x| x.abs() <= 1.0 + 1e-6)
    }
}

/// What the contacts of a step with obstacles leave for the next. It belongs to the
/// [`State`](crate::State): who takes over a state, or returns to one, takes over both
/// ([`Contacts::recall`]).
///
/// Contacts with other bodies are not in it. They begin anew.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct ContactState {
    /// Weight of a contact force in the way of the frame within a step, 0.5 to 1.
    pub weight: f64,
    /// Energy that steps with contacts have lost and not gained since, J.
    pub lost: f64,
    /// The contacts that carried force.
    pub memory: Vec<ContactMemory>,
}

impl Default for ContactState {
    /// No contacts.
    fn default() -> Self {
        Self { weight: 0.5, lost: 0.0, memory: Vec::new() }
    }
}

impl Clone for ContactState {
    fn clone(&self) -> Self {
        Self { memory: self.memory.clone(), ..*self }
    }

    /// Copies into the memory that is there, because every tick is remembered.
    fn clone_from(&mut self, from: &Self) {
        let Self { weight, lost, memory } = from;
        (self.weight, self.lost) = (*weight, *lost);
        self.memory.clone_from(memory);
    }
}

impl ContactState {
    /// Largest number of contacts that a state may have.
    pub const MAX: usize = 1024;
    /// Largest force (N), coordinate of an anchor (m) and lost energy (J) that a state may have.
    pub const LARGEST: f64 = 1e9;

    /// Whether all numbers are in their ranges, at most [`LARGEST`](Self::LARGEST), and each place
    /// is there once, in the order of obstacles and sites. What has crossed a network is checked
    /// with this.
    pub fn is_valid(&self) -> bool {
        let place = |m: &ContactMemory| (m.obstacle, m.site);
        (0.5..=1.0).contains(&self.weight)
            && (0.0..=Self::LARGEST).contains(&self.lost)
            && self.memory.len() <= Self::MAX
            && self.memory.iter().all(ContactMemory::is_valid)
            && self.memory.is_sorted_by(|a, b| place(a) < place(b))
    }

    /// Forgets all contacts.
    pub fn forget(&mut self) {
        self.clone_from(&Self::default());
    }
}

/// What one copy of a body may touch, and what the contacts of the last step left for the next.
///
/// It belongs to the state of the body: whoever steps a [`State`](crate::State) with contacts keeps
/// one of these beside it. See [`Kernel::step_touching`](crate::Kernel::step_touching).
#[derive(Debug, Clone)]
pub struct Contacts {
    /// Name of the body among those that are stepped with it.
    pub(crate) key: u64,
    friction: f64,
    obstacles: Vec<Arc<dyn ObstacleShape>>,
    pub(crate) attachments: Vec<Attachment>,
    pub(crate) places: Option<Arc<ContactSites>>,
    /// Modes of the body for which the sites were made.
    pub(crate) modes: usize,
    pub(crate) memory: Vec<Memory>,
    pub(crate) touching: Touching,
    pub(crate) bent: Bent,
    /// Pull, mean pull and viscoelastic state of the hands before the step.
    pub(crate) hands: Vec<[Vector3<f64>; 3]>,
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
            key: 0,
            friction: Self::FRICTION,
            obstacles: Vec::new(),
            attachments: Vec::new(),
            places: None,
            modes: 0,
            memory: Vec::new(),
            touching: Touching::default(),
            bent: Bent::default(),
            hands: Vec::with_capacity(crate::Body::MAX_GRABS),
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
    pub const MAX_FRICTION: f64 = 10.0;

    /// The body's coefficient of Coulomb friction, for sticking and sliding. It counts at obstacles
    /// that have none of their own, and at others the geometric mean of both. Default:
    /// [`Contacts::FRICTION`].
    pub fn friction(&self) -> f64 {
        self.friction
    }

    /// Sets the coefficient of friction, 0 to [`Contacts::MAX_FRICTION`].
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for another number. The old one then stays.
    pub fn set_friction(&mut self, friction: f64) -> Result<(), StepError> {
        let sound = (0.0..=Self::MAX_FRICTION).contains(&friction);
        StepError::check("friction", "0 to 10", sound, friction)?;
        self.friction = friction;
        Ok(())
    }

    /// The obstacles that the body may touch.
    pub fn obstacles(&self) -> &[Arc<dyn ObstacleShape>] {
        &self.obstacles
    }

    /// Sets the obstacles that the body may touch. Contacts with an obstacle go on with the one at
    /// the same index of the new list.
    ///
    /// # Errors
    /// Returns the error of [`ObstacleShape::check`]. The old obstacles then stay.
    pub fn set_obstacles(&mut self, obstacles: Vec<Arc<dyn ObstacleShape>>) -> Result<(), StepError> {
        obstacles.iter().try_for_each(|obstacle| obstacle.check())?;
        let left = |memory: &Memory| match memory.other {
            Touched::Obstacle(index) => index < obstacles.len(),
            Touched::Body(_) | Touched::Probe(_) | Touched::Attachment(_) => true,
        };
        self.memory.retain(left);
        self.obstacles = obstacles;
        Ok(())
    }

    /// Whether the body has neither obstacles nor attachments.
    pub(crate) fn are_none(&self) -> bool {
        self.obstacles.is_empty() && self.attachments.is_empty()
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
        self.begin_anew();
        self.attachments.iter_mut().for_each(|attachment| attachment.force = Vector3::zeros());
    }

    /// Forgets the contacts of the last step, and keeps the forces of the attachments.
    pub(crate) fn begin_anew(&mut self) {
        self.end();
        self.theta = 0.5;
        self.lost = 0.0;
    }

    /// Ends all contacts, for a step in which nothing is touched.
    pub(crate) fn end(&mut self) {
        self.memory.clear();
        self.list.clear();
        self.report = ContactReport::default();
    }

    /// Writes what the contacts with obstacles have left for the next step. Contacts whose numbers
    /// a [`ContactState`] cannot have are left out.
    pub fn remember(&self, into: &mut ContactState) {
        (into.weight, into.lost) = (self.theta, self.lost.min(ContactState::LARGEST));
        into.memory.clear();
        into.memory.extend(self.memory.iter().filter_map(|memory| {
            let Touched::Obstacle(obstacle) = memory.other else { return None };
            let memory = ContactMemory {
                obstacle: u16::try_from(obstacle).ok()?,
                site: u16::try_from(memory.site).ok()?,
                force: memory.force.into(),
                anchor: memory.anchor.into(),
                toward: memory.toward.into(),
                leads: memory.leads,
            };
            memory.is_valid().then_some(memory)
        }));
        into.memory.truncate(ContactState::MAX);
    }

    /// Takes over what contacts have left for the next step, in place of everything that the last
    /// step left. Contacts of obstacles or sites that the body lacks have no effect.
    pub fn recall(&mut self, from: &ContactState) {
        self.forget();
        (self.theta, self.lost) = (from.weight, from.lost);
        self.memory.extend(from.memory.iter().map(|memory| Memory {
            other: Touched::Obstacle(usize::from(memory.obstacle)),
            site: usize::from(memory.site),
            force: memory.force.into(),
            anchor: memory.anchor.into(),
            toward: memory.toward.into(),
            place: None,
            leads: memory.leads,
        }));
    }

    /// Keeps what the hands have before a step.
    pub(crate) fn save(&mut self, hands: &[Hand]) {
        self.hands.clear();
        self.hands.extend(hands.iter().map(|hand| [hand.pull, hand.mean, hand.viscoelastic]));
    }

    /// Gives hands what they had before the step.
    pub(crate) fn restore(&self, hands: &mut [Hand]) {
        for (hand, [pull, mean, viscoelastic]) in hands.iter_mut().zip(&self.hands) {
            (hand.pull, hand.mean, hand.viscoelastic) = (*pull, *mean, *viscoelastic);
        }
    }

    /// Where all sites are at the coordinates `q`, if it is known, and how far they may be from
    /// there, m.
    pub(crate) fn cloud(&self, q: &[f64]) -> Option<(&Cloud, f64)> {
        let known = self.bent.cloud.sites.len() == self.sites() && self.bent.q == q;
        known.then_some((&self.bent.cloud, self.bent.slack))
    }

    /// Takes over the sites of a body with `modes` modes and reserves memory.
    pub(crate) fn adopt(&mut self, sites: Arc<ContactSites>, modes: usize) {
        let count = sites.sites.len();
        let points = count * self.obstacles.len().clamp(1, 2);
        self.touching.reserve(points, modes + 6, count);
        self.memory.reserve(points.saturating_sub(self.memory.len()));
        self.list.reserve(points.saturating_sub(self.list.len()));
        if self.modes != modes {
            self.memory.clear();
        }
        self.modes = modes;
        self.places = Some(sites);
    }
}

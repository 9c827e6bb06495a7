//! A body as data: all that it needs to go on after it was saved and loaded.

use std::sync::Arc;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::{
    Body, BodyConfig, Contact, ContactState, GrabConfig, GrabId, HeldPlace, HeldShapes, ModalModel,
    ModelHash, Patch, State, StepError, StepSettings, Touched,
    contact::{Memory, Place},
    error::finite,
};

/// Most contacts that saved data may have, because each costs time in the next step.
const MOST_CONTACTS: usize = 16 * ContactState::MAX;

/// A [`Body`] as data that can be written to a file, made by [`Body::save`].
///
/// A body that [`Body::restore`] makes of it goes on as the saved one would have, to the bit. The
/// data are the running settings, the state, the grabs and the contacts. The model is not among
/// them, and is named by its hash. Obstacles and attachments are not either: obstacles are set
/// anew, at the same indices, and what was attached is attached again, without the force of the
/// last step.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SavedBody {
    model: Option<ModelHash>,
    settings: StepSettings,
    step: f64,
    state: State,
    hands: Vec<SavedHand>,
    shapes: Vec<HeldPlace>,
    contacts: SavedContacts,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedHand {
    vertex: u32,
    radius: f64,
    config: GrabConfig,
    target: [f64; 3],
    last_target: Option<[f64; 3]>,
    #[serde(default)]
    slip: [f64; 3],
    pull: [f64; 3],
    mean: [f64; 3],
    viscoelastic: [f64; 3],
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct SavedContacts {
    friction: f64,
    theta: f64,
    lost: f64,
    memory: Vec<Memory>,
    list: Vec<Contact>,
}

impl SavedBody {
    /// Step settings and step length (s) that the body had.
    pub fn settings(&self) -> (&StepSettings, f64) {
        (&self.settings, self.step)
    }

    /// The held patches whose own shapes the body had, as [`HeldShapes::places`] has them.
    pub fn shapes(&self) -> &[HeldPlace] {
        &self.shapes
    }

    /// Replaces the keys of the bodies that this one touches ([`Touched::Body`]). Who loads bodies
    /// may give them other keys than they had.
    pub fn map_keys(&mut self, mut map: impl FnMut(u64) -> u64) {
        let memory = self.contacts.memory.iter_mut().map(|memory| &mut memory.other);
        for other in memory.chain(self.contacts.list.iter_mut().map(|contact| &mut contact.other)) {
            if let Touched::Body(key) = other {
                *key = map(*key);
            }
        }
    }
}

impl Body {
    /// Returns the body as data, with the grabs that `keeps` selects. [`Body::push`] and
    /// [`Body::set_frame_motion`], which act on one step only, are not saved.
    pub fn save(&self, mut keeps: impl FnMut(GrabId) -> bool) -> SavedBody {
        let all = self.hands.iter().zip(&self.grabs).filter(|(_, grab)| keeps(grab.id));
        let hands = all.map(|(hand, grab)| {
            let (vertex, radius) = hand.patch.center_and_radius();
            SavedHand {
                vertex,
                radius,
                config: grab.config,
                target: grab.target.into(),
                last_target: grab.last_target.map(Into::into),
                slip: grab.slip.into(),
                pull: hand.pull.into(),
                mean: hand.mean.into(),
                viscoelastic: hand.viscoelastic.into(),
            }
        });
        let contacts = self.contacts();
        SavedBody {
            model: Some(self.model().hash()),
            settings: self.config().settings,
            step: self.config().step,
            state: self.state().clone(),
            hands: hands.collect(),
            shapes: self.held_shapes().map_or_else(Vec::new, |shapes| shapes.places().collect()),
            contacts: SavedContacts {
                friction: contacts.friction(),
                theta: contacts.theta,
                lost: contacts.lost,
                memory: contacts.memory.clone(),
                list: contacts.list.clone(),
            },
        }
    }

    /// Makes a body go on from saved data, and returns the identifiers of its grabs in the order in
    /// which they were saved.
    ///
    /// `config` gives the number of modes and the precision. Settings and step are those that were
    /// saved. `shapes` are those of [`SavedBody::shapes`]: without them the columns of the state
    /// are dropped, and the body goes on nearly as it was.
    ///
    /// # Errors
    /// Returns [`StepError::OtherModel`] for data of a body of another model, and the errors of
    /// [`Body::new`], [`Body::set_state`] and [`Body::grab`] for data that do not fit.
    pub fn restore(
        model: Arc<ModalModel>,
        config: BodyConfig,
        saved: &SavedBody,
        shapes: Option<Arc<HeldShapes>>,
    ) -> Result<(Self, Vec<GrabId>), StepError> {
        if saved.model != Some(model.hash()) {
            return Err(StepError::OtherModel);
        }
        let mut body = Self::new(model, BodyConfig { settings: saved.settings, step: saved.step, ..config })?;
        let mut ids = Vec::with_capacity(saved.hands.len());
        for hand in &saved.hands {
            let [target, last] = [hand.target, hand.last_target.unwrap_or_default()];
            for values in [target, last, hand.slip, hand.pull, hand.mean, hand.viscoelastic] {
                finite("saved hand", &values)?;
            }
            let patch = Patch::around(body.model().surface(), hand.vertex, hand.radius);
            let count = body.model().surface().positions().len();
            let patch = patch.map_err(|_| StepError::Vertex { vertex: hand.vertex, count })?;
            ids.push(body.grab(&patch, hand.config)?);
            if let Some(grab) = body.grabs.last_mut() {
                (grab.target, grab.last_target) = (target.into(), hand.last_target.map(Into::into));
            }
            if let Some(own) = body.hands.last_mut() {
                (own.pull, own.mean) = (hand.pull.into(), hand.mean.into());
                own.viscoelastic = hand.viscoelastic.into();
            }
        }
        body.set_held_shapes(shapes)?;
        let size = body.model().size();
        for (grab, hand) in body.grabs.iter_mut().zip(&saved.hands) {
            grab.slip = Vector3::from(hand.slip).cap_magnitude(size);
        }
        let columns = body.held_shapes().map_or(0, |shapes| shapes.columns());
        let mut state = saved.state.clone();
        if columns == 0 {
            state.s.clear();
        } else if state.s.len() != columns {
            return Err(StepError::Length { what: "s", expected: columns, got: state.s.len() });
        }
        body.set_state(&state)?;
        let SavedContacts { friction, theta, lost, memory, list } = &saved.contacts;
        body.set_friction(*friction)?;
        finite("saved contacts", &[*theta, *lost])?;
        if let Some(got) = [memory.len(), list.len()].into_iter().find(|got| *got > MOST_CONTACTS) {
            return Err(StepError::Length { what: "saved contacts", expected: MOST_CONTACTS, got });
        }
        for Memory { force, anchor, toward, place, .. } in memory {
            let weights = place.as_ref().map_or([0.0; 3], Place::weights);
            finite("saved contacts", &weights)?;
            [force, anchor, toward].into_iter().try_for_each(|x| finite("saved contacts", x.as_slice()))?;
        }
        let count = body.model().surface().positions().len();
        for Contact { vertex, point, normal, force, penetration, .. } in list {
            if *vertex as usize >= count {
                return Err(StepError::Vertex { vertex: *vertex, count });
            }
            [point, normal, force].into_iter().try_for_each(|x| finite("saved contacts", x))?;
            finite("saved contacts", &[*penetration])?;
        }
        let modes = body.mode_count();
        let contacts = body.contacts_mut();
        (contacts.modes, contacts.theta, contacts.lost) = (modes, theta.clamp(0.0, 1.0), *lost);
        contacts.memory.clone_from(memory);
        contacts.list.clone_from(list);
        Ok((body, ids))
    }
}

/// The form of a [`Memory`] in a file.
#[derive(Serialize, Deserialize)]
pub(crate) struct PlainMemory {
    other: Touched,
    site: usize,
    force: [f64; 3],
    anchor: [f64; 3],
    toward: [f64; 3],
    place: Option<Place>,
    leads: Option<f64>,
}

impl From<Memory> for PlainMemory {
    fn from(Memory { other, site, force, anchor, toward, place, leads }: Memory) -> Self {
        let [force, anchor, toward] = [force, anchor, toward].map(Into::into);
        Self { other, site, force, anchor, toward, place, leads }
    }
}

impl From<PlainMemory> for Memory {
    fn from(PlainMemory { other, site, force, anchor, toward, place, leads }: PlainMemory) -> Self {
        let [force, anchor, toward] = [force, anchor, toward].map(Vector3::from);
        Self { other, site, force, anchor, toward, place, leads }
    }
}

//! The own shapes of held patches ([`HeldShapes`]), made beside the frames.

use std::sync::Arc;

use bevy::{
    math::DVec3,
    prelude::*,
    tasks::{AsyncComputeTaskPool, Task, block_on, poll_once},
};
use pliant_modal::{HeldPlace, HeldShapes, ModalModel, ModelHash};

use crate::{BodyState, Driven, ModalBody};

/// The own shapes of the patches that hands hold, of all bodies with reduced elasticity.
///
/// Shapes take up to ten seconds to make. They are made on Bevy's compute threads when a hand
/// takes hold, and made anew for where the hand is when it has led the patch farther
/// ([`HeldShapes::wanted`]); the old ones serve until then. Until there are any, the hand feels
/// what the coordinates of the model leave out as a mere compliance. Shapes that were made once
/// stay for the next time that the same patches are held about there, as long as they are among the
/// last 32.
#[derive(Resource, Default)]
pub struct HeldShapesCache {
    /// The entry that was used last is at the end.
    entries: Vec<Entry>,
}

/// The number of entries that are kept. One takes up to about a megabyte.
const MAX: usize = 32;

/// The number of entries that are made at a time. Making those of four hands takes some hundred
/// megabytes. Whoever grabs one patch after another occupies no more of the compute threads, and
/// bodies that wait are served later.
const MAX_MAKING: usize = 2;

struct Entry {
    model: ModelHash,
    places: Vec<HeldPlace>,
    shapes: Making,
}

enum Making {
    Done(Option<Arc<HeldShapes>>),
    Task(Task<Option<HeldShapes>>),
}

impl HeldShapesCache {
    /// Returns the shapes of held patches of a model.
    ///
    /// The result is `None` while they are being made, which the first call begins, and
    /// `Some(None)` where there are none: see [`HeldShapes::of_places`].
    pub fn get(&mut self, model: &Arc<ModalModel>, places: &[HeldPlace]) -> Option<Option<Arc<HeldShapes>>> {
        let is_finite =
            |place: &HeldPlace| place.radius.is_finite() && place.displacement.iter().all(|x| x.is_finite());
        let has_mesh = model.parts().reduced.as_ref().is_some_and(|reduced| reduced.mesh.is_some());
        let is_few = !places.is_empty() && places.len() <= HeldShapes::MAX_PATCHES;
        if !is_few || !has_mesh || !places.iter().all(is_finite) {
            return Some(None);
        }
        self.take_made();
        let is_made = |entry: &Entry| matches!(entry.shapes, Making::Done(_));
        let entry = match self.entries.iter().position(|e| e.model == model.hash() && e.places == places) {
            Some(index) => self.entries.remove(index),
            None if self.entries.iter().filter(|e| !is_made(e)).count() >= MAX_MAKING => return None,
            None => Entry { model: model.hash(), shapes: begin(model, places), places: places.to_vec() },
        };
        let result = match &entry.shapes {
            Making::Done(shapes) => Some(shapes.clone()),
            Making::Task(_) => None,
        };
        if self.entries.len() >= MAX
            && let Some(oldest) = self.entries.iter().position(is_made)
        {
            self.entries.remove(oldest);
        }
        self.entries.push(entry);
        result
    }

    /// Returns the shapes that a body should change to, if it should change.
    ///
    /// `held` are the patches that hands hold, in any order; no more than
    /// [`HeldShapes::MAX_PATCHES`] of them get shapes. `own` are the shapes that the body has.
    pub fn change(
        &mut self,
        model: &Arc<ModalModel>,
        held: impl IntoIterator<Item = HeldPlace>,
        own: Option<&Arc<HeldShapes>>,
    ) -> Option<Option<Arc<HeldShapes>>> {
        let places = HeldShapes::wanted(model, held, own.map(|own| &**own))?;
        self.take_made();
        let key = |place: &HeldPlace| (place.vertex, place.radius.to_bits());
        // How far from the hands shapes were made, m. Those of further patches serve, too.
        let away = |shapes: &HeldShapes| {
            places.iter().try_fold(0.0f64, |most, place| {
                let made = shapes.places().find(|made| key(made) == key(place))?;
                Some(most.max(DVec3::from(made.displacement).distance(place.displacement.into())))
            })
        };
        let is_of = |entry: &&Entry| {
            entry.model == model.hash() && entry.places.iter().map(key).eq(places.iter().map(key))
        };
        // A hand that goes on asks for ever new ones. One set at a time is made for it.
        let is_known = self.entries.iter().filter(is_of).any(|entry| entry.places == places);
        let is_busy = self.entries.iter().filter(is_of).any(|e| matches!(e.shapes, Making::Task(_)));
        let found = if is_known || !is_busy { self.get(model, &places) } else { None };
        let now = own.and_then(|own| away(own)).filter(|_| !places.is_empty());
        // Until then, those serve that were made nearest to the hands.
        let found = found.or_else(|| {
            let made = self.entries.iter().filter(is_of).filter_map(|entry| match &entry.shapes {
                Making::Done(Some(shapes)) => Some((away(shapes)?, shapes)),
                _ => None,
            });
            let nearest = made.min_by(|a, b| a.0.total_cmp(&b.0));
            let nearest = nearest.filter(|(away, _)| now.is_none_or(|now| *away < now));
            nearest.map(|(_, shapes)| Some(shapes.clone()))
        });
        // Where none can be made, those that the body has of these patches are better than none.
        found.filter(|shapes| shapes.is_some() || (own.is_some() && now.is_none()))
    }

    /// Takes the shapes that are ready.
    fn take_made(&mut self) {
        for entry in &mut self.entries {
            if let Making::Task(task) = &mut entry.shapes
                && let Some(shapes) = block_on(poll_once(task))
            {
                entry.shapes = Making::Done(shapes.map(Arc::new));
            }
        }
    }

    /// Whether shapes are being made.
    pub fn is_making(&self) -> bool {
        self.entries.iter().any(|entry| matches!(entry.shapes, Making::Task(_)))
    }
}

fn begin(model: &Arc<ModalModel>, places: &[HeldPlace]) -> Making {
    let (model, places) = (model.clone(), places.to_vec());
    let make = async move { HeldShapes::of_places(&model, &places).ok().flatten() };
    Making::Task(AsyncComputeTaskPool::get().spawn(make))
}

/// Gives the held bodies the shapes of their patches as soon as these are made.
pub(crate) fn shape_held(
    mut cache: ResMut<HeldShapesCache>,
    mut bodies: Query<(&ModalBody, &Driven, &mut BodyState)>,
) {
    for (wanted, driven, mut state) in &mut bodies {
        let body = &state.body;
        if *driven != Driven::Local || !body.config().settings.is_reduced(body.model()) {
            continue;
        }
        // Fewer coordinates than the model has are stepped without shapes.
        let takes = wanted.held_shapes && body.mode_count() == body.model().mode_count();
        let held = body.held_places().filter(|_| takes);
        if let Some(shapes) = cache.change(body.model(), held, body.held_shapes()) {
            // The shapes are of this model, so that this cannot fail.
            let _ = state.body_mut().set_held_shapes(shapes);
        }
    }
}

//! Measures how far the shapes that a guest shows are from the host's shapes of the same ticks.
//!
//! The comparison is possible only because the host and the guests run in one process.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
};

use bevy::prelude::Resource;
use pliant::modal::ModalModel;

/// The host's states of the last few seconds by tick, written by the host's app and read by the
/// guests.
#[derive(Resource, Clone, Default)]
pub struct Truth(Arc<Mutex<VecDeque<(u64, Arc<[f64]>)>>>);

impl Truth {
    /// Number of ticks that are kept: 15 s at 40 Hz, many round trips.
    const KEPT: usize = 600;

    pub fn push(&self, tick: u64, q: &[f64]) {
        let mut states = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        states.push_back((tick, q.into()));
        while states.len() > Self::KEPT {
            states.pop_front();
        }
    }

    pub fn at(&self, tick: u64) -> Option<Arc<[f64]>> {
        let states = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let first = states.front()?.0;
        let index = usize::try_from(tick.checked_sub(first)?).ok()?;
        states.get(index).filter(|(t, _)| *t == tick).map(|(_, q)| q.clone())
    }

    pub fn newest(&self) -> Option<(u64, Arc<[f64]>)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).back().cloned()
    }
}

/// The errors of one guest's shapes against the host's shapes of the same ticks.
#[derive(Resource, Default, Clone)]
pub struct Meters {
    /// Errors of the streamed body, which depend on the recovery policy.
    pub streamed: Meter,
    /// Errors of the predicted body that is shown while the local hand holds the body.
    ///
    /// The host computes the same tick later. The effect of the other user's hand in between cannot
    /// be predicted here.
    pub predicted_hand: Meter,
    /// Errors of the streamed body if it were shown at those moments instead: the cost of no
    /// prediction.
    pub waiting: Meter,
    /// Largest reaction on the guest's local hand, N.
    pub reaction: f64,
}

impl Meters {
    /// Compares all shown shapes with the host's shapes of the same ticks, up to the host's newest
    /// tick.
    pub fn compare(&mut self, model: &ModalModel, truth: &Truth) {
        for meter in [&mut self.streamed, &mut self.predicted_hand, &mut self.waiting] {
            meter.compare(model, truth);
        }
    }
}

/// Accumulated errors of one kind of shape.
#[derive(Default, Clone)]
pub struct Meter {
    /// Shapes that were shown, with their ticks, until the host's shapes of these ticks exist.
    waiting: VecDeque<(u64, Vec<f64>)>,
    last_tick: u64,
    /// Number of ticks compared.
    pub ticks: u64,
    /// Sum over ticks of how many ticks the host was ahead.
    behind: u64,
    /// Sum over ticks of the mean squared error of the surface, m^2.
    sum: f64,
    /// Largest error of any vertex in any tick, m.
    pub max: f64,
    /// Root mean square error of the surface in the newest tick, m.
    pub now: f64,
    /// Largest true displacement of any vertex in any tick, m; percentages refer to it.
    pub largest: f64,
    shown: Vec<[f32; 3]>,
    truth: Vec<[f32; 3]>,
}

impl Meter {
    /// Records the shape that is shown and the tick that it stands for.
    ///
    /// A tick counts once, with the shape that was shown first.
    pub fn show(&mut self, tick: u64, shown: &[f64]) {
        if tick <= self.last_tick {
            return;
        }
        self.last_tick = tick;
        self.waiting.push_back((tick, shown.to_vec()));
        if self.waiting.len() > Truth::KEPT {
            self.waiting.pop_front();
        }
    }

    /// Compares the shown shapes with the host's shapes of the same ticks, up to the host's newest
    /// tick.
    fn compare(&mut self, model: &ModalModel, truth: &Truth) {
        let Some((newest, _)) = truth.newest() else { return };
        while let Some((tick, shown)) = self.waiting.pop_front_if(|(tick, _)| *tick <= newest) {
            if let Some(true_q) = truth.at(tick) {
                self.measure(model, tick, newest, &shown, &true_q);
            }
        }
    }

    fn measure(&mut self, model: &ModalModel, tick: u64, newest: u64, shown: &[f64], true_q: &[f64]) {
        let rest = model.surface().positions();
        let single = |q: &[f64]| q.iter().map(|x| *x as f32).collect::<Vec<f32>>();
        self.shown.resize(rest.len(), [0.0; 3]);
        self.truth.resize(rest.len(), [0.0; 3]);
        model.basis().reconstruct(&single(shown), true, &mut self.shown);
        model.basis().reconstruct(&single(true_q), true, &mut self.truth);
        let distance2 =
            |a: &[f32; 3], b: &[f32; 3]| (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>();
        let (mut sum, mut worst, mut moved) = (0.0, 0.0f64, 0.0f64);
        for ((shown, truth), rest) in self.shown.iter().zip(&self.truth).zip(rest) {
            let error = distance2(shown, truth);
            sum += error;
            worst = worst.max(error);
            moved = moved.max(distance2(truth, rest));
        }
        let mean = sum / rest.len().max(1) as f64;
        self.ticks += 1;
        self.behind += newest.saturating_sub(tick);
        self.sum += mean;
        self.now = mean.sqrt();
        self.max = self.max.max(worst.sqrt());
        self.largest = self.largest.max(moved.sqrt());
    }

    /// Returns the root mean square error over ticks and surface, m.
    pub fn rms(&self) -> f64 {
        (self.sum / self.ticks.max(1) as f64).sqrt()
    }

    /// Returns the mean number of ticks by which the host was ahead of the shown shape.
    pub fn behind(&self) -> f64 {
        self.behind as f64 / self.ticks.max(1) as f64
    }

    /// Returns a length as a percentage of the largest true displacement.
    pub fn percent(&self, length: f64) -> f64 {
        if self.largest > 0.0 { 100.0 * length / self.largest } else { 0.0 }
    }
}

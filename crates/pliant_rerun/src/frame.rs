//! The messages from the app to a worker: all data of one tick, without borrows from the app.

use std::{borrow::Cow, ops::Range, sync::Arc};

use pliant_modal::ModalModel;

/// The data of one tick.
#[derive(Debug, Default)]
pub(crate) struct RecordedFrame {
    pub tick: u64,
    /// Simulated time, s.
    pub time: f64,
    /// Wall time, s since the epoch.
    pub wall: f64,
    /// Bodies that a worker may not know yet. A worker ignores the bodies that it knows.
    pub arrived: Vec<Arc<Drawn>>,
    /// Paths of removed bodies.
    pub left: Vec<Arc<str>>,
    pub shapes: Vec<ShapeFrame>,
    /// The modal coordinates of all shapes, in sequence.
    pub coordinates: Vec<f32>,
    /// Energies of the modes of the shapes that have them, J, in sequence.
    pub energies: Vec<f64>,
    pub color: crate::RerunColor,
    /// All hands of the tick. `None` if hands are not due, and if there are none now and were none
    /// before.
    pub hands: Option<Vec<RecordedHand>>,
    /// Where bodies touch, if that has changed.
    pub contacts: Vec<RecordedContact>,
    pub contacts_changed: bool,
    /// Diagnostics that were measured since the last tick.
    pub measured: Vec<(Arc<Metric>, f64)>,
    pub scalars: Vec<Scalar>,
    /// Metrics that are sampled faster than ticks.
    pub samples: Vec<Samples>,
    pub lines: Vec<Line>,
    /// Reused memory for the hands of a later tick.
    pub room: Vec<RecordedHand>,
}

impl RecordedFrame {
    /// Returns an empty frame that keeps the memory of this one.
    pub fn cleared(mut self) -> Self {
        if let Some(hands) = self.hands.take() {
            self.room = hands;
        }
        self.room.clear();
        self.arrived.clear();
        self.left.clear();
        self.shapes.clear();
        self.coordinates.clear();
        self.energies.clear();
        self.contacts.clear();
        self.contacts_changed = false;
        self.measured.clear();
        self.scalars.clear();
        self.samples.clear();
        self.lines.clear();
        self
    }

    /// Returns an empty list of hands in reused memory.
    pub fn take_room(&mut self) -> Vec<RecordedHand> {
        std::mem::take(&mut self.room)
    }

    /// Returns the modal coordinates of a shape.
    pub fn coordinates(&self, shape: &ShapeFrame) -> &[f32] {
        self.coordinates.get(shape.coordinates.clone()).unwrap_or_default()
    }

    /// Returns the energies of a shape's modes, J.
    pub fn energies(&self, shape: &ShapeFrame) -> Option<&[f64]> {
        self.energies.get(shape.energies.clone()?)
    }
}

/// The data that a worker missed because its queue was full, sent with the next frame.
#[derive(Debug, Default)]
pub(crate) struct Owed {
    /// All existing bodies. Bodies that are not in this list were removed.
    pub bodies: Vec<Arc<Drawn>>,
    pub lines: Vec<Line>,
    /// Whether the last missed list of hands was empty, so that the drawn hands must be removed.
    pub no_hands: bool,
    /// The last missed list of the places where bodies touch.
    pub contacts: Option<Vec<RecordedContact>>,
}

impl Owed {
    /// Maximum number of lines that are kept.
    const LINES: usize = 1024;

    pub fn add(&mut self, missed: &RecordedFrame) {
        let room = Self::LINES.saturating_sub(self.lines.len());
        self.lines.extend(missed.lines.iter().take(room).cloned());
        if let Some(hands) = &missed.hands {
            self.no_hands = hands.is_empty();
        }
        if missed.contacts_changed {
            self.contacts = Some(missed.contacts.clone());
        }
    }
}

/// A drawn body.
#[derive(Debug)]
pub(crate) struct Drawn {
    pub path: Arc<str>,
    pub model: Arc<ModalModel>,
    pub style: crate::RerunStyle,
}

/// A body in one tick.
#[derive(Debug)]
pub(crate) struct ShapeFrame {
    pub body: Arc<Drawn>,
    /// Range of the body's modal coordinates in those of the frame.
    pub coordinates: Range<usize>,
    pub warped: bool,
    pub place: BodyTransform,
    /// Stiffness as a multiple of the baked stiffness.
    pub stiffness: f32,
    /// Whether the shape is drawn in this tick.
    pub draw: bool,
    /// Whether metrics are recorded in this tick.
    pub metrics: bool,
    /// Whether a sample for the spectrum is taken in this tick.
    pub sample: bool,
    /// Range of the mode energies in those of the frame.
    pub energies: Option<Range<usize>>,
    /// Whether the energies are drawn as bars.
    pub bars: bool,
}

/// The pose and the scale of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BodyTransform {
    pub translation: [f32; 3],
    /// Quaternion x, y, z, w.
    pub rotation: [f32; 4],
    pub scale: f32,
}

#[derive(Debug, Clone)]
pub(crate) struct RecordedHand {
    pub name: Arc<str>,
    /// Color of the hand's user, sRGB. `None` selects one of the recording's own colors.
    pub color: Option<[u8; 3]>,
    /// Reaction, N.
    pub force: [f64; 3],
    pub point: [f64; 3],
    pub target: [f64; 3],
}

/// A place where a body touches an obstacle or another body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RecordedContact {
    pub point: [f32; 3],
    /// Force on the body, N.
    pub force: [f32; 3],
    pub sliding: bool,
}

#[derive(Debug, Clone)]
pub(crate) struct Scalar {
    pub path: Cow<'static, str>,
    pub unit: Cow<'static, str>,
    pub value: f64,
}

/// The path and the unit of a metric.
#[derive(Debug)]
pub(crate) struct Metric {
    pub path: String,
    pub unit: String,
}

/// Values of a metric at their own times, oldest first.
#[derive(Debug)]
pub(crate) struct Samples {
    pub path: String,
    pub unit: &'static str,
    /// Time before the tick, s, and the value.
    pub values: Vec<(f64, f64)>,
}

#[derive(Debug, Clone)]
pub(crate) struct Line {
    pub warning: bool,
    pub text: String,
}

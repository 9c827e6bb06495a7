//! What goes from the app to a worker: everything of one tick in one message, and nothing that borrows from the app.

use std::{borrow::Cow, ops::Range, sync::Arc};

use pliant_modal::ModalModel;

/// One tick.
#[derive(Debug, Default)]
pub(crate) struct Frame {
    pub tick: u64,
    /// Simulated time, s.
    pub time: f64,
    /// Wall time, s since the epoch.
    pub wall: f64,
    /// Bodies that this worker may not know yet; a worker that does passes them over.
    pub arrived: Vec<Arc<Drawn>>,
    /// Paths of bodies that are gone.
    pub left: Vec<Arc<str>>,
    pub shapes: Vec<Shape>,
    /// The modal coordinates of all shapes, one after the other.
    pub coordinates: Vec<f32>,
    /// Energies of the modes of the shapes that have them, J, one after the other.
    pub energies: Vec<f64>,
    pub color: crate::RerunColor,
    /// All hands of the tick; `None` when they are not due, and when there are none and were none before.
    pub hands: Option<Vec<Hand>>,
    /// Diagnostics that were measured since the last tick.
    pub measured: Vec<(Arc<Metric>, f64)>,
    pub scalars: Vec<Scalar>,
    /// Figures that came faster than ticks.
    pub samples: Vec<Samples>,
    pub lines: Vec<Line>,
    /// Room for the hands of the frame that this one will be used for again.
    pub room: Vec<Hand>,
}

impl Frame {
    /// The frame without what is in it, but with the memory that it had.
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
        self.measured.clear();
        self.scalars.clear();
        self.samples.clear();
        self.lines.clear();
        self
    }

    /// An empty list of hands, in memory that was one before.
    pub fn take_room(&mut self) -> Vec<Hand> {
        std::mem::take(&mut self.room)
    }

    /// The modal coordinates of a shape.
    pub fn coordinates(&self, shape: &Shape) -> &[f32] {
        self.coordinates.get(shape.coordinates.clone()).unwrap_or_default()
    }

    /// The energies of a shape's modes, J.
    pub fn energies(&self, shape: &Shape) -> Option<&[f64]> {
        self.energies.get(shape.energies.clone()?)
    }
}

/// What a worker had no room for, and has to be told with the next frame.
#[derive(Debug, Default)]
pub(crate) struct Owed {
    /// All bodies that there are; those that are not among them are gone.
    pub bodies: Vec<Arc<Drawn>>,
    pub lines: Vec<Line>,
    /// The last hands that it missed were none: what it draws is gone.
    pub no_hands: bool,
}

impl Owed {
    /// Most lines that are kept.
    const LINES: usize = 1024;

    pub fn add(&mut self, missed: &Frame) {
        let room = Self::LINES.saturating_sub(self.lines.len());
        self.lines.extend(missed.lines.iter().take(room).cloned());
        if let Some(hands) = &missed.hands {
            self.no_hands = hands.is_empty();
        }
    }
}

/// A body as it is drawn.
#[derive(Debug)]
pub(crate) struct Drawn {
    pub path: Arc<str>,
    pub model: Arc<ModalModel>,
    pub style: crate::RerunStyle,
}

/// A body in one tick.
#[derive(Debug)]
pub(crate) struct Shape {
    pub body: Arc<Drawn>,
    /// Where its modal coordinates are in the frame's.
    pub coordinates: Range<usize>,
    pub warped: bool,
    pub place: Place,
    /// Stiffness as a multiple of the baked one.
    pub stiffness: f32,
    /// What is wanted of it now: its picture,
    pub draw: bool,
    /// its figures,
    pub metrics: bool,
    /// and a sample for its spectrum.
    pub sample: bool,
    /// Where the energies of its modes are in the frame's.
    pub energies: Option<Range<usize>>,
    /// Whether those are drawn as bars.
    pub bars: bool,
}

/// Where a body is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    pub translation: [f32; 3],
    /// x, y, z, w.
    pub rotation: [f32; 4],
    pub scale: f32,
}

#[derive(Debug, Clone)]
pub(crate) struct Hand {
    pub name: Arc<str>,
    /// Of whose hand it is, sRGB; `None` takes one of the recording's own.
    pub color: Option<[u8; 3]>,
    /// Reaction, N.
    pub force: [f64; 3],
    pub point: [f64; 3],
    pub target: [f64; 3],
}

#[derive(Debug, Clone)]
pub(crate) struct Scalar {
    pub path: Cow<'static, str>,
    pub unit: Cow<'static, str>,
    pub value: f64,
}

/// A figure by its path, and its unit.
#[derive(Debug)]
pub(crate) struct Metric {
    pub path: String,
    pub unit: String,
}

/// A figure at moments of its own, oldest first.
#[derive(Debug)]
pub(crate) struct Samples {
    pub path: String,
    pub unit: &'static str,
    /// How long before the tick, s, and the value.
    pub values: Vec<(f64, f64)>,
}

#[derive(Debug, Clone)]
pub(crate) struct Line {
    pub warning: bool,
    pub text: String,
}

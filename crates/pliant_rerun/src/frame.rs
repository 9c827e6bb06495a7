//! What goes from the app to a worker: everything of one tick in one message, and nothing that borrows from the app.

use std::{borrow::Cow, sync::Arc};

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
    pub colour: crate::RerunColour,
    /// All hands of the tick; `None` when there are none and were none before.
    pub hands: Option<Vec<Hand>>,
    pub scalars: Vec<Scalar>,
    pub lines: Vec<Line>,
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
    pub q: Vec<f32>,
    pub warped: bool,
    pub place: Place,
    /// Stiffness as a multiple of the baked one.
    pub stiffness: f32,
    /// What is wanted of it now: its picture,
    pub draw: bool,
    /// its figures,
    pub figures: bool,
    /// and a sample for its spectrum.
    pub sample: bool,
    /// Energy of each mode, J; `None` when the bars are not due.
    pub energies: Option<Vec<f64>>,
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
    pub colour: Option<[u8; 3]>,
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

#[derive(Debug, Clone)]
pub(crate) struct Line {
    pub warning: bool,
    pub text: String,
}

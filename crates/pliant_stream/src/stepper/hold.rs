//! How a patch is held in one step, and how what lies under a hand relaxes.

use nalgebra::{Matrix3, Vector3};
use pliant_modal::{GrabConfig, Relaxation};

use crate::wire::FrameGrab;

/// How a patch is held in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hold {
    pub(crate) vertex: u32,
    pub(crate) radius: f64,
    pub(crate) by: By,
    /// Force on the body, N: what was measured (body axes), and after the step what acted (world axes where the frame was
    /// stepped with it).
    pub(crate) pull: Vector3<f64>,
    /// How far the residual flexibility of a hand's patch has flown, body axes, m; see [`pliant_modal::Body::grab_flow`].
    pub(crate) flow: Vector3<f64>,
}

/// What holds a patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum By {
    /// The patch was measured at this displacement from rest (body axes, m), with the hold's `pull`.
    Measured(Vector3<f64>),
    /// A hand, as the body itself knows it.
    Hand {
        /// World, m; for an anchored body the body's own axes.
        target: Vector3<f64>,
        /// How fast the target moves, m/s.
        velocity: Vector3<f64>,
        /// Its spring and damper.
        config: GrabConfig,
    },
}

impl Hold {
    /// A grab as the stream tells of it.
    pub(crate) fn measured(g: &FrameGrab, back: &Matrix3<f64>) -> Self {
        Self {
            vertex: g.state.vertex,
            radius: g.state.radius,
            pull: -(back * Vector3::from(g.state.reaction)),
            by: By::Measured(g.displacement.into()),
            flow: Vector3::zeros(),
        }
    }

    /// A hand at a target.
    pub(crate) fn hand(
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        velocity: Vector3<f64>,
        config: GrabConfig,
    ) -> Self {
        let by = By::Hand { target: target.into(), velocity, config };
        Self { vertex, radius, by, pull: Vector3::zeros(), flow: Vector3::zeros() }
    }
}

/// What the modes leave out under a hand, where the material relaxes: `d = C pull + ratio y`, `time y' = d - y`; see
/// [`pliant_modal::Relaxation`]. With the pull held over a step `y1 = carry y0 + gain C pull`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Creeping {
    pub(super) ratio: f64,
    pub(super) carry: f64,
    gain: f64,
    /// Compliance within a step, as a multiple of the instantaneous one.
    pub(super) at_once: f64,
}

impl Default for Creeping {
    fn default() -> Self {
        Self { ratio: 0.0, carry: 0.0, gain: 0.0, at_once: 1.0 }
    }
}

impl Creeping {
    pub(super) fn new(material: Relaxation, h: f64) -> Self {
        let left = 1.0 - material.ratio;
        let gone = -(-left * h / material.time).exp_m1();
        Self { ratio: material.ratio, carry: 1.0 - gone, gain: gone / left, at_once: material.creep(h) }
    }

    pub(super) fn step(&self, flow: Vector3<f64>, bent: Vector3<f64>) -> Vector3<f64> {
        self.carry * flow + self.gain * bent
    }
}

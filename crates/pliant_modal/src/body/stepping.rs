//! The recurrences of a body's modes from its configuration.

use super::BodyConfig;
use crate::{Coefficients, Flow, ModalModel, StepError};

/// What the steps of a configuration are made of.
pub(super) struct Stepping {
    /// rad/s, with the scale of stiffness.
    pub(super) omega: Vec<f64>,
    /// 1/s, with both scales.
    pub(super) damping: Vec<f64>,
    pub(super) coefficients: Vec<Coefficients>,
    /// Empty where the material does not relax.
    pub(super) flows: Vec<Flow>,
}

impl Stepping {
    pub(super) fn new(model: &ModalModel, config: &BodyConfig, modes: usize) -> Result<Self, StepError> {
        let scale = config.damping_scale;
        StepError::check("damping_scale", "finite, 0 or more", scale.is_finite() && scale >= 0.0, scale)?;
        let stiffness = config.stiffness_scale;
        let sound = (1e-6..=1e6).contains(&stiffness);
        StepError::check("stiffness_scale", "1e-6 to 1e6", sound, stiffness)?;
        let (mut omega, mut damping) = (Vec::with_capacity(modes), Vec::with_capacity(modes));
        for mode in 0..modes {
            let (w, c) = model.stiffened(mode, stiffness);
            omega.push(w);
            damping.push(c * scale);
        }
        let kept = omega.iter().zip(&damping);
        let (coefficients, flows) = match config.relaxation {
            Some(relaxation) => kept
                .map(|(&w, &c)| Coefficients::relaxing(config.integrator, w, c, relaxation, config.step))
                .collect::<Result<(Vec<_>, Vec<_>), _>>()?,
            None => {
                let elastic = kept.map(|(&w, &c)| Coefficients::new(config.integrator, w, c, config.step));
                (elastic.collect::<Result<_, _>>()?, Vec::new())
            }
        };
        Ok(Self { omega, damping, coefficients, flows })
    }
}

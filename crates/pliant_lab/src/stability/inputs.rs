//! Inputs that are not finite: the body rejects them by name, and nothing changes.

use pliant_modal::{Body, BodyConfig, GrabConfig, Integrator, StepError, StepSettings};

use super::{Bound, Case, CaseOutcome, bodies::BarBody};
use crate::LabError;

const BAD: [(&str, f64); 3] =
    [("NaN", f64::NAN), ("infinity", f64::INFINITY), ("minus infinity", f64::NEG_INFINITY)];

pub(super) fn cases(out: &mut Vec<Case>) {
    for (name, bad) in BAD {
        out.push(Case::new("inputs", format!("{name} everywhere"), move || refused(bad)));
    }
    out.push(Case::new("inputs", "pushes beyond the largest number".into(), || {
        let bar = BarBody { zeta: 0.0, ..BarBody::default() };
        let model = bar.bake()?;
        let config = BodyConfig::from(StepSettings { integrator: Integrator::Newmark, ..Default::default() });
        let mut body = Body::new(model.clone(), config)?;
        let vertex = bar.vertex(&model, [1.0, 0.5, 0.5]);
        for _ in 0..9 {
            body.push(vertex, [f64::MAX, 0.0, 0.0])?;
        }
        let taken_back = matches!(body.step(), Err(StepError::Diverged { .. }));
        let moved = body.q().iter().fold(0.0f64, |m, q| m.max(q.abs()));
        body.step()?;
        Ok(CaseOutcome::of(vec![
            Bound::new("steps that went on with it", f64::from(u8::from(!taken_back)), 0.5),
            Bound::new("what is left of it in the coordinates", moved, f64::MIN_POSITIVE),
        ]))
    }));
}

fn refused(bad: f64) -> Result<CaseOutcome, LabError> {
    let bar = BarBody::default();
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig::default())?;
    let grab = body.grab(&bar.tip(&model)?, GrabConfig::default())?;
    let mut spoilt = body.state().clone();
    spoilt.q[0] = bad;
    let accepted = [
        body.set_target(grab, [bad, 0.0, 0.0]).is_ok(),
        body.push(0, [0.0, bad, 0.0]).is_ok(),
        body.apply_impulse(0, [0.0, 0.0, bad]).is_ok(),
        body.set_state(&spoilt).is_ok(),
        body.set_pose([bad, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).is_ok(),
        body.set_pose([0.0; 3], [0.0, bad, 0.0, 1.0]).is_ok(),
        body.set_grab_viscoelastic_state(grab, [bad, 0.0, 0.0]).is_ok(),
        Body::new(model.clone(), BodyConfig { step: bad, ..BodyConfig::default() }).is_ok(),
        Body::new(model.clone(), BodyConfig::from(StepSettings { damping_scale: bad, ..Default::default() }))
            .is_ok(),
        Body::new(model, BodyConfig::from(StepSettings { gravity: [0.0, bad, 0.0], ..Default::default() }))
            .is_ok(),
    ];
    for _ in 0..100 {
        body.step()?;
    }
    let moved = body.q().iter().fold(0.0f64, |m, q| m.max(q.abs()));
    Ok(CaseOutcome::of(vec![
        Bound::new("bad numbers let in", accepted.iter().filter(|a| **a).count() as f64, 0.5),
        Bound::new("what moved because of them", moved, 1e-12),
    ]))
}

//! Hands with extreme input: they teleport, tremble, twist, oppose each other, share a patch, hold
//! an anchor, or outnumber the modes.

use nalgebra::Vector3;
use pliant_modal::{Body, BodyConfig, GrabConfig, GrabId, ModalModel, Patch, StepSettings};

use super::{
    Bound, Case, CaseOutcome,
    bodies::{BarBody, HeldCase, RESTED, STILL, compliance, gain, modal_compliance, settling},
    plain,
};
use crate::LabError;

pub(super) fn cases(out: &mut Vec<Case>) {
    for young in [1e3, 1e6, 1e9, 1e12] {
        for step in [1e-3, 1.0 / 60.0] {
            out.push(Case::new(
                "teleport",
                format!("100 sizes, E {young:.0e} Pa, h {step:.4} s"),
                move || teleport(young, step),
            ));
            out.push(Case::new(
                "encoder jitter",
                format!("55 um each step, E {young:.0e} Pa, h {step:.4} s"),
                move || jitter(young, step),
            ));
        }
        for corrections in [2, 8] {
            let name = format!("two turns, E {young:.0e} Pa, {corrections} corrections a step");
            out.push(Case::new("twist", name, move || twist(young, corrections)));
        }
        for stiffness in [None, Some(1.0), Some(1e3), Some(1e9)] {
            let word = stiffness.map_or("no spring of their own".to_owned(), |k| format!("{k:.0e} N/m each"));
            out.push(Case::new("opposed hands", format!("E {young:.0e} Pa, {word}"), move || {
                opposed(young, stiffness)
            }));
        }
    }
    for hands in [2, 6, Body::MAX_GRABS] {
        out.push(Case::new("coincident grabs", format!("{hands} on one patch"), move || coincident(hands)));
    }
    for young in [1e3, 1e9] {
        out.push(Case::new("grab on an anchor", format!("E {young:.0e} Pa, alone"), move || {
            on_anchor(young, false)
        }));
        out.push(Case::new(
            "grab on an anchor",
            format!("E {young:.0e} Pa, beside one on the tip"),
            move || on_anchor(young, true),
        ));
    }
    for (modes, hands) in [
        (1, 1),
        (1, 4),
        (5, 1),
        (5, 2),
        (6, 2),
        (5, 10),
        (12, 4),
        (5, Body::MAX_GRABS),
        (20, Body::MAX_GRABS),
    ] {
        let name = format!("{} rows, {modes} modes", 3 * hands);
        out.push(Case::new("grab rows against modes", name, move || many(modes, hands)));
    }
    out.push(Case::new("a million steps", "held".into(), || {
        let bar = BarBody { modes: 6, zeta: 0.3, ..BarBody::default() };
        let mut held = HeldCase::new(&bar, BodyConfig::default(), GrabConfig::default())?;
        let away = [0.0, 0.05, 0.02];
        held.pull(away)?;
        let mut settled = Vector3::zeros();
        let mut drift = 0.0f64;
        for i in 0..1_000_000 {
            held.body.step()?;
            if i == 10_000 {
                settled = held.reaction()?;
            } else if i > 10_000 {
                drift = drift.max((held.reaction()? - settled).norm() / settled.norm());
            }
        }
        Ok(CaseOutcome::of(vec![Bound::new("drift of the reaction / reaction", drift, 1e-12)])
            .stepped(&held.body))
    }));
    out.push(Case::new("a million steps", "dragged to and fro".into(), || {
        let bar = BarBody { modes: 6, zeta: 0.1, ..BarBody::default() };
        let mut held = HeldCase::new(&bar, BodyConfig::default(), GrabConfig::default())?;
        let mut peaks = [0.0f64; 2];
        for i in 0..1_000_000u32 {
            let t = f64::from(i) / 60.0;
            held.pull([0.02 * (0.7 * t).sin(), 0.1 * (0.9 * t).sin(), 0.1 * (1.3 * t).cos() - 0.1])?;
            held.body.step()?;
            let part = usize::from(i >= 500_000);
            peaks[part] = peaks[part].max(held.reaction()?.norm());
        }
        Ok(CaseOutcome::of(vec![Bound::new(
            "largest reaction of the second half / of the first",
            peaks[1] / peaks[0],
            1.01,
        )])
        .stepped(&held.body))
    }));
    for density in [1.0, 1e6] {
        for stiffness in [None, Some(500.0)] {
            let word = stiffness.map_or("a stiff hand".to_owned(), |k| format!("a hand of {k} N/m"));
            out.push(Case::new(
                "mass ratio",
                format!("free body of {density:.0e} kg/m^3 dragged by {word}"),
                move || light_and_heavy(density, stiffness),
            ));
        }
    }
}

/// Moves the target to and fro a hundred sizes away, then releases the patch.
fn teleport(young: f64, step: f64) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { young, zeta: 0.05, ..BarBody::default() };
    let mut held = HeldCase::new(&bar, BodyConfig { step, ..BodyConfig::default() }, GrabConfig::default())?;
    let away = |i: usize| {
        let far = if i.is_multiple_of(7) { 100.0 } else { -100.0 };
        [far, far, -far]
    };
    let (mut force, mut energy) = (0.0f64, 0.0f64);
    for i in 0..400 {
        held.pull(away(i))?;
        held.body.step()?;
        force = force.max(held.reaction()?.norm());
        energy = energy.max(held.body.energy());
    }
    // The hand's own compliance allows this force from a body's size away.
    let softest = compliance(&held.body, held.grab)?.symmetric_eigenvalues().min();
    let allowed = held.model.size() / softest;
    held.body.release(held.grab);
    for _ in 0..settling(&held.model, step) {
        held.body.step()?;
    }
    let plain = plain::beside(&held.model, step, &[held.patch], 400, |i| vec![away(i)])?;
    Ok(CaseOutcome::of(vec![
        gain("largest reaction / what the compliance allows - 1", force / allowed),
        Bound::new("energy left when let go / largest", held.body.energy() / energy, RESTED),
    ])
    .beside(plain)
    .stepped(&held.body))
}

/// Flips the target each step by the resolution of a cheap encoder.
fn jitter(young: f64, step: f64) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { young, length: 0.15, ..BarBody::default() };
    let mut held = HeldCase::new(&bar, BodyConfig { step, ..BodyConfig::default() }, GrabConfig::default())?;
    let size = 55e-6;
    let away = |i: usize| {
        let to = if i.is_multiple_of(2) { size } else { 0.0 };
        [0.0, to, -to]
    };
    let mut peaks = [0.0f64; 2];
    for i in 0..10_000 {
        held.pull(away(i))?;
        held.body.step()?;
        let part = usize::from(i >= 5_000);
        peaks[part] = peaks[part].max(held.reaction()?.norm());
    }
    let softest = compliance(&held.body, held.grab)?.symmetric_eigenvalues().min();
    // The patch itself may be as far away as the target, on the other side.
    let allowed = 2.0 * size * std::f64::consts::SQRT_2 / softest;
    let plain = plain::beside(&held.model, step, &[held.patch], 10_000, |i| vec![away(i)])?;
    Ok(CaseOutcome::of(vec![
        Bound::new("largest reaction / twice the jitter over the compliance", peaks[0] / allowed, 1.0),
        Bound::new("largest reaction of the second half / of the first", peaks[1] / peaks[0], 1.01),
    ])
    .beside(plain)
    .stepped(&held.body))
}

/// Four hands on the corners of the end turn it about the axis by two full turns, hold it and
/// release it.
fn twist(young: f64, corrections: u8) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { young, zeta: 0.05, modes: 30, ..BarBody::default() };
    let model = bar.bake()?;
    let mut body =
        Body::new(model.clone(), BodyConfig::from(StepSettings { corrections, ..Default::default() }))?;
    let mut hands: Vec<(GrabId, Vector3<f64>)> = Vec::new();
    let mut patches = Vec::new();
    for corner in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]] {
        let vertex = bar.vertex(&model, [1.0, corner[0], corner[1]]);
        let patch = Patch::around(model.surface(), vertex, 0.06)?;
        let grab = body.grab(&patch, GrabConfig::default())?;
        hands.push((grab, body.grab_position(grab)?.into()));
        patches.push(patch);
    }
    let axis = Vector3::new(0.0, 0.1, 0.1);
    let turned = |start: &Vector3<f64>, i: usize| {
        let angle = 2.0 * std::f64::consts::TAU * crate::smooth(i as f64 / 600.0);
        let (sin, cos) = angle.sin_cos();
        let arm = start - axis;
        Vector3::new(start.x, axis.y + cos * arm.y - sin * arm.z, axis.z + sin * arm.y + cos * arm.z)
    };
    let (mut farthest, mut energy) = (0.0f64, 0.0f64);
    let mut last = Vec::new();
    for i in 0..900 {
        for (grab, start) in &hands {
            body.set_target(*grab, turned(start, i).into())?;
        }
        body.step()?;
        for (grab, start) in &hands {
            farthest = farthest.max((Vector3::from(body.grab_position(*grab)?) - start).norm());
        }
        energy = energy.max(body.energy());
        if i >= 860 {
            last.push(Vector3::from(body.reaction(hands[0].0)?));
        }
    }
    let held = last.windows(2).map(|w| (w[1] - w[0]).norm()).fold(0.0, f64::max)
        / last.iter().fold(f64::MIN_POSITIVE, |m, f| m.max(f.norm()));
    for (grab, _) in &hands {
        body.release(*grab);
    }
    for _ in 0..settling(&model, 1.0 / 60.0) {
        body.step()?;
    }
    let starts: Vec<Vector3<f64>> = hands.iter().map(|h| h.1).collect();
    let plain = plain::beside(&model, 1.0 / 60.0, &patches, 900, |i| {
        starts.iter().map(|s| (turned(s, i) - s).into()).collect()
    })?;
    Ok(CaseOutcome::of(vec![
        Bound::new("farthest a corner goes / size", farthest / model.size(), 0.6),
        Bound::new("change of a held reaction in a step / reaction", held, 0.02),
        Bound::new("energy left when let go / largest", body.energy() / energy, RESTED),
    ])
    .beside(plain)
    .stepped(&body))
}

/// Two hands on opposite sides of the end pull apart by a tenth of the length.
fn opposed(young: f64, stiffness: Option<f64>) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { young, zeta: 0.1, ..BarBody::default() };
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig::default())?;
    let hand = GrabConfig { stiffness, ..GrabConfig::default() };
    let mut patches = Vec::new();
    let mut grabs = Vec::new();
    for (share, sign) in [([1.0, 0.0, 0.5], -1.0), ([1.0, 1.0, 0.5], 1.0)] {
        let patch = Patch::around(model.surface(), bar.vertex(&model, share), 0.12)?;
        let grab = body.grab(&patch, hand)?;
        let start = body.grab_position(grab)?;
        body.set_target(grab, [start[0], start[1] + 0.1 * sign, start[2]])?;
        grabs.push(grab);
        patches.push(patch);
    }
    for _ in 0..settling(&model, 1.0 / 60.0) {
        body.step()?;
    }
    let rest = Vector3::from(body.reaction(grabs[0])?);
    let mut off = 0.0f64;
    for _ in 0..100 {
        body.step()?;
        off = off.max((Vector3::from(body.reaction(grabs[0])?) - rest).norm() / rest.norm());
    }
    let plain =
        plain::beside(&model, 1.0 / 60.0, &patches, 600, |_| vec![[0.0, -0.1, 0.0], [0.0, 0.1, 0.0]])?;
    let outcome = CaseOutcome::of(vec![Bound::new("unrest of the reaction / reaction", off, STILL)]);
    let outcome = outcome.stepped(&body);
    Ok(if stiffness.is_none() { outcome.beside(plain) } else { outcome })
}

/// Hands on one patch must share the force that a single hand with their joint compliance gets.
fn coincident(hands: usize) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { zeta: 0.3, ..BarBody::default() };
    let model = bar.bake()?;
    let patch = bar.tip(&model)?;
    let mut body = Body::new(model.clone(), BodyConfig::default())?;
    let away = Vector3::new(0.0, 1e-6, 0.5e-6);
    let mut grabs = Vec::new();
    for _ in 0..hands {
        let grab = body.grab(&patch, GrabConfig::default())?;
        let start = Vector3::from(body.grab_position(grab)?);
        body.set_target(grab, (start + away).into())?;
        grabs.push(grab);
    }
    for _ in 0..settling(&model, 1.0 / 60.0) {
        body.step()?;
    }
    let mut sum = Vector3::zeros();
    for grab in &grabs {
        sum -= Vector3::from(body.reaction(*grab)?);
    }
    let whole = compliance(&body, grabs[0])? / hands as f64 + modal_compliance(&model, &patch);
    let want = whole.try_inverse().map_or_else(|| Vector3::repeat(f64::NAN), |inverse| inverse * away);
    let patches = vec![patch; hands];
    let plain = plain::beside(&model, 1.0 / 60.0, &patches, 600, |_| vec![away.into(); hands])?;
    Ok(CaseOutcome::of(vec![Bound::new(
        "|sum of reactions - static| / static",
        (sum - want).norm() / want.norm(),
        2e-4,
    )])
    .beside(plain)
    .stepped(&body))
}

/// A hand on an anchor must get the force of its own contact compliance and nothing else.
fn on_anchor(young: f64, beside: bool) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { young, zeta: 0.3, ..BarBody::default() };
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig::default())?;
    let patch = Patch::around(model.surface(), bar.vertex(&model, [0.0, 0.5, 0.5]), 0.0)?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let start = Vector3::from(body.grab_position(grab)?);
    let away = Vector3::new(0.01, 0.02, -0.01);
    body.set_target(grab, (start + away).into())?;
    if beside {
        let tip = body.grab(&bar.tip(&model)?, GrabConfig::default())?;
        let at = body.grab_position(tip)?;
        body.set_target(tip, [at[0], at[1] + 0.05, at[2]])?;
    }
    for _ in 0..settling(&model, 1.0 / 60.0) {
        body.step()?;
    }
    let want = compliance(&body, grab)?
        .try_inverse()
        .map_or_else(|| Vector3::repeat(f64::NAN), |inverse| inverse * away);
    let got = -Vector3::from(body.reaction(grab)?);
    let plain = plain::beside(&model, 1.0 / 60.0, &[patch], 10, |_| vec![away.into()])?;
    Ok(CaseOutcome::of(vec![Bound::new(
        "|reaction - contact's| / contact's",
        (got - want).norm() / want.norm(),
        1e-12,
    )])
    .beside(plain)
    .stepped(&body))
}

fn spread(bar: &BarBody, model: &ModalModel, hands: usize) -> Result<Vec<Patch>, LabError> {
    (0..hands)
        .map(|k| {
            let along = 0.3 + 0.7 * k as f64 / hands.max(2) as f64;
            let share = [along, f64::from(k as u32 % 2), f64::from(k as u32 / 2 % 2)];
            Ok(Patch::around(model.surface(), bar.vertex(model, share), 0.12)?)
        })
        .collect()
}

/// More rows than modes: the hands contradict each other, and the body must still come to rest.
fn many(modes: usize, hands: usize) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { modes, zeta: 0.2, ..BarBody::default() };
    let model = bar.bake()?;
    let patches = spread(&bar, &model, hands)?;
    let mut body = Body::new(model.clone(), BodyConfig::default())?;
    let mut grabs = Vec::new();
    let away = |k: usize| [0.01, 0.05 * if k.is_multiple_of(2) { 1.0 } else { -1.0 }, 0.02];
    for (k, patch) in patches.iter().enumerate() {
        let grab = body.grab(patch, GrabConfig::default())?;
        let start = body.grab_position(grab)?;
        let by = away(k);
        body.set_target(grab, std::array::from_fn(|i| start[i] + by[i]))?;
        grabs.push(grab);
    }
    for _ in 0..settling(&model, 1.0 / 60.0) {
        body.step()?;
    }
    let reactions = |body: &Body| -> Result<Vec<Vector3<f64>>, LabError> {
        grabs.iter().map(|g| Ok(Vector3::from(body.reaction(*g)?))).collect()
    };
    let before = reactions(&body)?;
    let largest = before.iter().fold(f64::MIN_POSITIVE, |m, f| m.max(f.norm()));
    let mut off = 0.0f64;
    for _ in 0..100 {
        body.step()?;
        for (a, b) in before.iter().zip(reactions(&body)?) {
            off = off.max((b - a).norm() / largest);
        }
    }
    let plain = plain::beside(&model, 1.0 / 60.0, &patches, 600, |_| (0..hands).map(away).collect())?;
    Ok(CaseOutcome::of(vec![Bound::new("unrest of the reactions / largest", off, STILL)])
        .beside(plain)
        .stepped(&body))
}

/// Pulls a free body to and fro. The cases have masses a million times apart under the same hand.
fn light_and_heavy(density: f64, stiffness: Option<f64>) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { held: None, density, modes: 12, zeta: 0.1, ..BarBody::default() };
    let model = bar.bake()?;
    let patch = bar.tip(&model)?;
    let hand = GrabConfig { stiffness, relaxation: 1.0 / 60.0 };
    let mut held = HeldCase::of(model, patch, BodyConfig::default(), hand)?;
    let mut peaks = [0.0f64; 2];
    let mut farthest = 0.0f64;
    for i in 0..12_000u32 {
        let t = f64::from(i) / 60.0;
        held.pull([0.1 * (0.9 * t).sin(), 0.1 * (1.1 * t).sin(), 0.0])?;
        held.body.step()?;
        let part = usize::from(i >= 6_000);
        peaks[part] = peaks[part].max(held.reaction()?.norm());
        let hand = Vector3::from(held.body.target(held.grab)?);
        farthest = farthest.max((Vector3::from(held.body.frame().center()) - hand).norm());
    }
    Ok(CaseOutcome::of(vec![
        Bound::new("largest reaction of the second half / of the first", peaks[1] / peaks[0], 1.5),
        // The hand holds an end, half a length from the center.
        Bound::new("farthest of the center from the hand / length", farthest / bar.length, 1.0),
    ])
    .stepped(&held.body))
}

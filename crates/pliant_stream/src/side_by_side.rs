//! Compares a body with a receiver's copy and with a peer's body: the same inputs must give the
//! same states.

use std::{path::Path, sync::Arc};

use nalgebra::Vector3;
use pliant_modal::{
    Body, BodyConfig, GrabConfig, Integrator, Load, ModalModel, Patch, Relaxation, StepSettings,
};

use crate::peer::{InputLog, LateInputRepair, PeerBody};
use crate::prediction::BodyCopy;
use crate::replica::Replica;
use crate::state::{BodyId, GrabKey, GrabState, State, UserId};
use crate::wire::{FrameGrab, HeldAt, InputTick};

/// Largest allowed difference, as a share of the largest value of the same kind in the run.
const SAME: f64 = 1e-12;

fn model(name: &str) -> Arc<ModalModel> {
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets");
    Arc::new(ModalModel::read(assets.join(name)).unwrap())
}

/// Returns the surface vertex that is farthest along an axis.
fn end(model: &ModalModel, axis: [f32; 3]) -> u32 {
    let along = |p: &[f32; 3]| p[0] * axis[0] + p[1] * axis[1] + p[2] * axis[2];
    let positions = model.surface().positions();
    let far = |&a: &usize, &b: &usize| along(&positions[a]).total_cmp(&along(&positions[b]));
    (0..positions.len()).max_by(far).unwrap() as u32
}

/// A hand of a test case: its patch, its hold, and the total displacement of its target (m).
struct SideBySide {
    vertex: u32,
    radius: f64,
    config: GrabConfig,
    way: [f64; 3],
}

fn hand(vertex: u32, radius: f64, way: [f64; 3]) -> SideBySide {
    SideBySide { vertex, radius, config: GrabConfig::default(), way }
}

/// Largest differences of displacements, velocities, reactions and centers between two bodies.
type Off = [f64; 4];

fn off(body: &Body, state: &State, reactions: impl Iterator<Item = ([f64; 3], Vector3<f64>)>) -> Off {
    let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
    let center = Vector3::from(body.frame().center()) - Vector3::from(state.frame.center());
    let reaction = reactions.fold(0.0, |m: f64, (a, b)| m.max((Vector3::from(a) - b).norm()));
    [apart(body.q(), &state.q), apart(body.v(), &state.v), reaction, center.norm()]
}

/// Steps the body, a receiver's copy and a peer's body `steps` times and compares states and
/// reactions after each step.
fn compare(name: &str, model: &Arc<ModalModel>, config: BodyConfig, cases: &[SideBySide], steps: usize) {
    let h = config.step;
    let settings = config.settings;
    let mut body = Body::new(model.clone(), config).unwrap();
    let grabs: Vec<_> = cases
        .iter()
        .map(|case| {
            let patch = Patch::around(model.surface(), case.vertex, case.radius).unwrap();
            let id = body.grab(&patch, case.config).unwrap();
            (id, Vector3::from(body.target(id).unwrap()))
        })
        .collect();
    let mut copy = Replica::new(model.clone(), settings, model.mode_count(), h).unwrap();
    let mut stepped = BodyCopy::new(copy.kernel().at_rest());
    let key = |number: usize| GrabKey { user: UserId(1), grab: number as u16 };
    let (user, number) = (UserId(1), BodyId(1));
    let mut peer = PeerBody::new(number, model.clone(), &settings, h, LateInputRepair::Rollback, 0).unwrap();
    let mut inputs = InputLog::default();
    inputs.expect(user, 1);
    let mut largest = [0.0f64; 3];
    let mut differences = Vec::new();
    for step in 0..steps {
        let share = (step as f64 * h / 0.5).min(1.0);
        let share = share * share * (3.0 - 2.0 * share);
        let targets: Vec<Vector3<f64>> =
            cases.iter().zip(&grabs).map(|(case, (_, at))| at + share * Vector3::from(case.way)).collect();
        for ((id, _), target) in grabs.iter().zip(&targets) {
            body.set_target(*id, (*target).into()).unwrap();
        }
        body.step().unwrap();
        copy.release_all();
        for (i, case) in cases.iter().enumerate() {
            copy.hold_at(&stepped, key(i), (case.vertex, case.radius), targets[i], case.config);
        }
        copy.step_held(&mut stepped, &Load::default());
        let held = cases.iter().zip(&targets).enumerate().map(|(i, (case, target))| HeldAt {
            body: number,
            grab: i as u16,
            vertex: case.vertex,
            radius: case.radius,
            target: (*target).into(),
            hold: case.config,
        });
        inputs.put(user, InputTick { tick: step as u64 + 1, held: held.collect(), ..Default::default() });
        peer.advance(&inputs);

        for (kind, values) in [body.q(), body.v()].into_iter().enumerate() {
            largest[kind] = values.iter().fold(largest[kind], |m, x| m.max(x.abs()));
        }
        let reactions: Vec<[f64; 3]> = grabs.iter().map(|(id, _)| body.reaction(*id).unwrap()).collect();
        for reaction in &reactions {
            largest[2] = largest[2].max(Vector3::from(*reaction).norm());
        }
        let pulls = (0..cases.len()).map(|i| -stepped.hand(key(i)).unwrap().pull);
        let copied = off(&body, &stepped.state, reactions.iter().copied().zip(pulls));
        let shown = peer.grabs().iter().map(|grab| Vector3::from(grab.reaction));
        assert_eq!(peer.grabs().len(), cases.len(), "{name}, step {step}");
        let peers = off(&body, peer.live(), reactions.iter().copied().zip(shown));
        differences.push([("a copy", copied), ("a peer", peers)]);
    }
    let scale = [largest[0], largest[1], largest[2], model.size()];
    for (step, (who, off)) in
        differences.iter().enumerate().flat_map(|(step, both)| both.iter().map(move |one| (step, one)))
    {
        let [q, v, reaction, apart] = [0, 1, 2, 3].map(|kind| off[kind] / scale[kind]);
        assert!(
            [q, v, reaction, apart].iter().all(|off| *off <= SAME),
            "{name}, {who}, step {step}: q is off by {q:.1e} of its largest, v by {v:.1e}, the reaction by \
             {reaction:.1e}; the frames are {apart:.1e} sizes apart"
        );
    }
    assert!(largest[2] > 0.0, "{name}: nothing was held");
}

#[test]
fn a_damped_hand() {
    let bud = model("bud.modal");
    let tip = end(&bud, [0.0, 1.0, 0.0]);
    let config = GrabConfig { relaxation: 0.02, ..GrabConfig::default() };
    let hands = [SideBySide { config, ..hand(tip, 0.1 * bud.size(), [0.05 * bud.size(), 0.0, 0.0]) }];
    compare("damped", &bud, BodyConfig { step: 1.0 / 64.0, ..Default::default() }, &hands, 128);
}

#[test]
fn a_free_jack_stretched() {
    let jack = model("jack.modal");
    let way = 0.5 * 0.4 * jack.size();
    let hands = [1.0, -1.0]
        .map(|side| hand(end(&jack, [side as f32, 0.0, 0.0]), 0.03, [side * way, 0.003 * side, 0.0]));
    compare("stretched", &jack, BodyConfig { step: 1.0 / 64.0, ..Default::default() }, &hands, 256);
}

#[test]
fn eight_corrections() {
    let pip = model("pip.modal");
    let tip = end(&pip, [0.0, 1.0, 0.0]);
    let size = pip.size();
    let hands = [hand(tip, 0.08 * size, [0.3 * size, 0.1 * size, 0.0])];
    compare(
        "corrections",
        &pip,
        BodyConfig::from(StepSettings { corrections: 8, ..Default::default() }),
        &hands,
        128,
    );
}

#[test]
fn a_relaxing_body() {
    let pip = model("pip.modal");
    let tip = end(&pip, [0.0, 1.0, 0.0]);
    let relaxation = Some(Relaxation { ratio: 0.5, time: 0.2 });
    for integrator in [Integrator::Exact, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
        let hands = [hand(tip, 0.08 * pip.size(), [0.2 * pip.size(), 0.0, 0.0])];
        let config = BodyConfig::from(StepSettings { integrator, relaxation, ..Default::default() });
        compare("relaxing", &pip, config, &hands, 128);
    }
}

#[test]
fn two_hands() {
    let pip = model("pip.modal");
    let size = pip.size();
    let soft = GrabConfig { stiffness: Some(200.0), ..GrabConfig::default() };
    let (right, left) = (end(&pip, [1.0, 0.0, 0.0]), end(&pip, [-1.0, 0.0, 0.0]));
    let hands = [
        hand(right, 0.08 * size, [0.2 * size, 0.1 * size, 0.0]),
        SideBySide { config: soft, ..hand(left, 0.05 * size, [0.0, 0.2 * size, -0.1 * size]) },
    ];
    compare("two hands", &pip, BodyConfig::default(), &hands, 128);
}

#[test]
fn under_gravity() {
    let pip = model("pip.modal");
    let tip = end(&pip, [0.0, 1.0, 0.0]);
    let config = BodyConfig::from(StepSettings { gravity: [0.0, -9.81, 0.0], ..Default::default() });
    compare("gravity", &pip, config, &[hand(tip, 0.02, [0.02, 0.0, 0.0])], 64);
}

/// Steps a body with hands, and a copy of the body with the displacements and reactions that a
/// frame carries. The second hand begins 40 steps later. Returns the largest difference of a
/// coordinate as a share of the largest coordinate.
fn observed(model: &Arc<ModalModel>, settings: StepSettings, cases: &[SideBySide; 2]) -> f64 {
    let mut body = Body::new(model.clone(), settings.into()).unwrap();
    let mut copy = Replica::new(model.clone(), settings, model.mode_count(), body.config().step).unwrap();
    let mut stepped = BodyCopy::new(copy.kernel().at_rest());
    let mut grabs = Vec::new();
    let (mut largest, mut off) = (0.0f64, 0.0f64);
    for step in 0..120 {
        for (number, case) in cases.iter().enumerate() {
            if step == 40 * number {
                let patch = Patch::around(model.surface(), case.vertex, case.radius).unwrap();
                let id = body.grab(&patch, case.config).unwrap();
                grabs.push((id, Vector3::from(body.target(id).unwrap()), case));
            }
        }
        for (number, (id, at, case)) in grabs.iter().enumerate() {
            let share = ((step - 40 * number) as f64 / 60.0).min(1.0);
            body.set_target(*id, (at + share * Vector3::from(case.way)).into()).unwrap();
        }
        body.step().unwrap();
        let frame: Vec<FrameGrab> = grabs
            .iter()
            .enumerate()
            .map(|(number, (id, _, case))| FrameGrab {
                state: GrabState {
                    key: GrabKey { user: UserId(1), grab: number as u16 },
                    vertex: case.vertex,
                    radius: case.radius,
                    target: body.target(*id).unwrap(),
                    reaction: body.reaction(*id).unwrap(),
                    hold: case.config,
                },
                displacement: copy.displacement(body.q(), case.vertex, case.radius),
                held: true,
            })
            .collect();
        let end = copy.end_frame(&stepped, None);
        copy.step_measured(&mut stepped, &frame, &vec![0.0; model.mode_count()], end);
        for (a, b) in body.q().iter().zip(&stepped.state.q) {
            (largest, off) = (largest.max(a.abs()), off.max((a - b).abs()));
        }
    }
    assert!(largest > 0.0, "nothing was held");
    off / largest
}

#[test]
fn places_and_reactions_tell_the_same_as_targets() {
    let pip = model("pip.modal");
    let size = pip.size();
    let (right, left) = (end(&pip, [1.0, 0.0, 0.0]), end(&pip, [-1.0, 0.0, 0.0]));
    let soft = GrabConfig { stiffness: Some(200.0), relaxation: 0.02 };
    let cases = [
        hand(right, 0.08 * size, [0.2 * size, 0.1 * size, 0.0]),
        SideBySide { config: soft, ..hand(left, 0.05 * size, [0.0, 0.2 * size, -0.1 * size]) },
    ];
    let relaxation = Some(Relaxation { ratio: 0.5, time: 0.2 });
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    let plain = StepSettings::default();
    for (settings, most) in [
        (StepSettings { warp: false, ..plain }, SAME),
        (StepSettings { warp: false, second_order: false, ..plain }, SAME),
        (StepSettings { warp: false, integrator: alpha, ..plain }, SAME),
        (StepSettings { warp: false, relaxation, ..plain }, SAME),
        (plain, 2e-5),
    ] {
        let off = observed(&pip, settings, &cases);
        println!("{settings:?}: {off:.1e}");
        assert!(off < most, "{settings:?}: {off:.1e}");
    }
}

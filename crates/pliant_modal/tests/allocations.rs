//! Tests that a step allocates nothing. They have their own test binary because they count through
//! the global allocator.
#![allow(clippy::unwrap_used, reason = "a failed test should panic")]
#![allow(unsafe_code, reason = "counting allocations needs a global allocator")]

mod nonlinear_rod;
mod rod;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    sync::Arc,
};

use nonlinear_rod::nonlinear_rod;
use pliant_modal::{
    Body, BodyConfig, Elasticity, FrameMotion, GrabConfig, Integrator, Islands, Patch, Plane, Probe,
    ProbeConfig, Relaxation, StepSettings, Together,
};
use rod::{rod, tip};

struct Counting;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: Every call goes to the system allocator unchanged. The counter is a plain thread-local
// cell without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.with(|n| n.set(n.get() + 1));
        // SAFETY: The caller upholds the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        CALLS.with(|n| n.set(n.get() + 1));
        // SAFETY: The caller upholds the contract of `dealloc`.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn a_step_with_two_grabs_under_warp_allocates_nothing() {
    let material = Relaxation { ratio: 0.5, time: 0.1 };
    for (free, relaxation) in [(false, None), (true, None), (false, Some(material)), (true, Some(material))] {
        for integrator in [Integrator::Exact, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
            let model = Arc::new(rod(2e5, 20, 0.05, free));
            let gravity = [0.0, -9.81, 0.0];
            let config = BodyConfig {
                step: 1.0 / 240.0,
                settings: StepSettings { integrator, relaxation, gravity, ..Default::default() },
                ..Default::default()
            };
            let mut body = Body::new(model.clone(), config).unwrap();
            let grabs = [tip(), tip() / 2].map(|vertex| {
                let patch = Patch::around(model.surface(), vertex, 0.06).unwrap();
                // The hands have different dampers, which makes the system non-symmetric.
                let relaxation = if vertex == tip() { 0.02 } else { 0.0 };
                let grab = body.grab(&patch, GrabConfig { relaxation, ..GrabConfig::default() }).unwrap();
                (grab, body.grab_position(grab).unwrap())
            });
            let mut positions = model.surface().positions().to_vec();
            let before = CALLS.with(Cell::get);
            for step in 0..100 {
                for (grab, start) in grabs {
                    let x = start[0] + 1e-4 * f64::from(step);
                    body.set_target(grab, [x, start[1] + 0.01, start[2]]).unwrap();
                }
                body.push(3, [0.1, 0.0, 0.0]).unwrap();
                body.step().unwrap();
                body.reconstruct(&mut positions).unwrap();
            }
            assert_eq!(CALLS.with(Cell::get) - before, 0, "free {free}, {integrator:?}, {relaxation:?}");
            assert!(body.reaction(grabs[0].0).unwrap()[0].abs() > 0.0, "it was held");
        }
    }
}

#[test]
fn a_step_with_reduced_elasticity_allocates_nothing() {
    let model = Arc::new(nonlinear_rod(2e5, 20, 0.05));
    let settings = StepSettings { elasticity: Elasticity::Reduced, ..Default::default() };
    let mut body = Body::new(model.clone(), settings.into()).unwrap();
    let grabs = [tip(), tip() / 2].map(|vertex| {
        let patch = Patch::around(model.surface(), vertex, 0.06).unwrap();
        let grab = body.grab(&patch, GrabConfig { relaxation: 0.01, ..GrabConfig::default() }).unwrap();
        (grab, body.grab_position(grab).unwrap())
    });
    let before = CALLS.with(Cell::get);
    for step in 0..100 {
        for (grab, start) in grabs {
            // The jump at the end is far, so that the rounds go on.
            let x = start[0] + if step < 90 { 1e-3 * f64::from(step) } else { 0.6 };
            body.set_target(grab, [x, start[1], start[2]]).unwrap();
        }
        body.step().unwrap();
    }
    assert_eq!(CALLS.with(Cell::get) - before, 0);
    assert!(body.reaction(grabs[0].0).unwrap()[0].abs() > 0.0, "it was held");
}

#[test]
fn a_step_that_bends_under_gravity_allocates_nothing() {
    let pip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    let model = Arc::new(pliant_modal::ModalModel::read(pip).unwrap());
    let settings = StepSettings { gravity: [0.0, -9.81, 3.0], ..Default::default() };
    let mut body = Body::new(model, settings.into()).unwrap();
    let before = CALLS.with(Cell::get);
    for _ in 0..100 {
        body.step().unwrap();
    }
    assert_eq!(CALLS.with(Cell::get) - before, 0);
    assert!(body.energy() > 0.0, "it bends");
}

#[test]
fn a_step_whose_anchors_move_allocates_nothing() {
    let pip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    let model = Arc::new(pliant_modal::ModalModel::read(pip).unwrap());
    let mut body = Body::new(model, BodyConfig::default()).unwrap();
    let motion = FrameMotion {
        acceleration: [3.0, -1.0, 0.5],
        angular_velocity: [0.0, 4.0, 0.0],
        angular_acceleration: [2.0, 0.0, 1.0],
    };
    body.set_frame_motion(motion).unwrap();
    let before = CALLS.with(Cell::get);
    for _ in 0..100 {
        body.set_frame_motion(motion).unwrap();
        body.step().unwrap();
    }
    assert_eq!(CALLS.with(Cell::get) - before, 0);
    assert!(body.energy() > 0.0, "it bends");
}

#[test]
fn a_step_with_contacts_allocates_nothing() {
    let free = rod(2e5, 20, 0.05, true);
    let jack = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    let jack = pliant_modal::ModalModel::read(jack).unwrap();
    for model in [free, jack] {
        let model = Arc::new(model);
        let settings = StepSettings { gravity: [0.0, -9.81, 0.0], ..Default::default() };
        let mut body = Body::new(model.clone(), settings.into()).unwrap();
        let low = f64::from(model.surface().bounds()[0][1]);
        body.set_pose([0.0, 0.02 - low, 0.0], [0.0, 0.0, 0.1, 1.0]).unwrap();
        let wall = Plane { point: [-0.3, 0.0, 0.0], normal: [1.0, 0.2, 0.0] };
        body.set_obstacles(vec![Arc::new(Plane::GROUND), Arc::new(wall)]).unwrap();
        let before = CALLS.with(Cell::get);
        let mut touched = 0;
        for _ in 0..120 {
            body.step().unwrap();
            touched = touched.max(body.contacts().report().contacts);
        }
        assert_eq!(CALLS.with(Cell::get) - before, 0);
        assert!(touched > 1, "it touched the ground");
    }
}

#[test]
fn a_step_of_bodies_that_touch_each_other_allocates_nothing_once_they_have_touched() {
    let jack = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    let model = Arc::new(pliant_modal::ModalModel::read(jack).unwrap());
    let settings = StepSettings { gravity: [0.0, -9.81, 0.0], ..Default::default() };
    let low = f64::from(model.surface().bounds()[0][1]);
    let [mut below, mut above] = [0.0, 1.1].map(|height| {
        let mut body = Body::new(model.clone(), settings.into()).unwrap();
        body.set_pose([0.0, height * model.size() - low, 0.0], [0.0, 0.0, 0.1, 1.0]).unwrap();
        body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
        body
    });
    let mut islands = Islands::default();
    let (mut calls, mut touched) = (0, false);
    for step in 0..240 {
        let before = CALLS.with(Cell::get);
        islands.step(&mut [Together::new(0, &mut below), Together::new(1, &mut above)], |_, _| true);
        // The first contacts make room.
        if step >= 120 {
            calls += CALLS.with(Cell::get) - before;
        }
        let other = |contact: &pliant_modal::Contact| contact.other == pliant_modal::Touched::Body(0);
        touched |= step >= 120 && above.contacts().contacts().iter().any(other);
    }
    assert!(touched, "they touched");
    assert_eq!(calls, 0);
}

#[test]
fn a_step_with_a_probe_allocates_nothing_once_it_has_touched() {
    let pip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    let model = Arc::new(pliant_modal::ModalModel::read(pip).unwrap());
    let mut body = Body::new(model.clone(), StepSettings::default().into()).unwrap();
    let top = *model.surface().positions().iter().max_by(|a, b| a[1].total_cmp(&b[1])).unwrap();
    let top = top.map(f64::from);
    let above = [top[0], top[1] + 0.02, top[2]];
    let config = ProbeConfig::default();
    let mut probes = [Probe::new(config, above).unwrap()];
    let floor = Plane { point: [0.0, top[1] - 0.01, 0.0], normal: [0.0, 1.0, 0.0] };
    probes[0].set_obstacles(vec![Arc::new(floor)]).unwrap();
    let (mut islands, mut calls, mut touched) = (Islands::default(), 0, 0);
    for step in 0..240 {
        let phase = f64::from(step) * 0.1;
        let down = 0.012 * (1.0 - phase.cos());
        probes[0].set_target([above[0] + 0.005 * phase.sin(), above[1] - down, above[2]]).unwrap();
        let before = CALLS.with(Cell::get);
        let mut all = [Together::new(0, &mut body)];
        islands.step_with(&mut all, &mut probes, 1.0 / 60.0, |_, _| true, |_, _| true);
        // The first contacts make room.
        if step >= 120 {
            calls += CALLS.with(Cell::get) - before;
            touched += usize::from(probes[0].force() != [0.0; 3]);
        }
    }
    assert!(touched > 20 && touched < 120, "it touches and lets go: {touched}");
    assert_eq!(calls, 0);
}

//! Guests show the own shapes of the patch that a hand holds as the host has them.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a failed test should panic")]

mod support;

use std::sync::Arc;
use std::time::Duration;

use pliant_bake::{BakeConfig, Material, bake};
use pliant_lab::pair::{Pair, PathConfig, World};
use pliant_mesh::shapes;
use pliant_modal::{Elasticity, GrabConfig, HeldShapes, ModalModel, Patch, StepSettings};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::{
    GrabKey, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession, HostSessionConfig, UserId,
};
use support::scene::{BODY, HandScript, S, Scene, cached};

/// Radius of the held patch, m, which is the same in the single precision of the network.
const RADIUS: f64 = 0.0625;

/// A bar of 1 m by 0.1 m by 0.1 m along x, clamped at x = 0, and the vertex at a corner of its end.
fn bar() -> (Arc<ModalModel>, u32) {
    let config = BakeConfig {
        modes: 20,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse().unwrap()],
        ..Default::default()
    };
    let mesh = shapes::bar([10, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    let model = bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model;
    let corner = model.surface().positions().iter().position(|p| *p == [1.0, 0.1, 0.1]).unwrap();
    (Arc::new(model), corner as u32)
}

struct Watch {
    scene: Scene,
    shapes: Option<Arc<HeldShapes>>,
    guest_has_shapes: bool,
    /// The tick and the reaction of the predicted hand, N.
    felt: Vec<(u64, [f64; 3])>,
    /// The tick, the columns of the shown state, and those of the host.
    columns: Vec<(u64, Vec<f64>)>,
    of_host: Vec<(u64, Vec<f64>)>,
}

impl World for Watch {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        let body = &mut self.scene.body;
        if body.held_shapes().is_none() && body.held_places().len() > 0 {
            body.set_held_shapes(self.shapes.clone()).unwrap();
        }
        self.scene.step(now, tick, host);
        self.of_host.push((tick, self.scene.body.state().s.clone()));
    }
    fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
        self.scene.host_event(now, event, host);
    }
    fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
        self.scene.guest_event(now, guest, event, s);
    }
    fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, session: &mut GuestSession) {
        self.scene.guest_stepped(now, guest, stepped, session);
        let Some(view) = session.body(BODY).filter(|_| stepped > 0) else { return };
        let own = view.held_shapes().is_some();
        if guest == 0
            && now > 6 * S
            && let Some(predicted) = view.predicted_hand()
        {
            self.felt.extend(predicted.reaction(1).or(predicted.reaction(0)).map(|f| (predicted.tick(), f)));
        }
        // The second guest only watches.
        if guest == 1
            && now > 6 * S
            && let Some((_, s)) = view.held_shapes()
        {
            self.columns.push((view.tick(), s.to_vec()));
        }
        if self.guest_has_shapes && !own && !view.held_places().is_empty() {
            session.set_held_shapes(BODY, self.shapes.clone());
        }
    }
}

/// Leads the corner slowly about.
fn hand(corner: u32) -> HandScript {
    let mut grab = None;
    Box::new(move |now, guest, session| {
        if guest != 0 || session.user().is_none() {
            return;
        }
        let t = now.as_secs_f64();
        let grow = ((t - 2.0) / 2.0).clamp(0.0, 1.0);
        let way = [0.06 + 0.03 * (1.1 * t).sin(), 0.05 + 0.03 * (0.8 * t).cos()].map(|x| grow * x);
        let target = [1.0, 0.1 + way[0], 0.1 + way[1]];
        match grab {
            None => grab = session.begin_grab(now, BODY, corner, RADIUS, target, GrabConfig::default()).ok(),
            Some(g) => session.set_target(g, target).unwrap(),
        }
    })
}

/// Returns the error of the predicted reaction, root mean square, as a share of the largest, and
/// the same of the columns that a guest shows who only watches.
fn run(model: &Arc<ModalModel>, corner: u32, preset: Preset, guest_has_shapes: bool) -> [f64; 2] {
    let patch = Patch::around(model.surface(), corner, RADIUS).unwrap();
    let settings =
        StepSettings { elasticity: Elasticity::Reduced, damping_scale: 10.0, ..Default::default() };
    let mut pair = Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), settings).unwrap();
    let mut watch = Watch {
        scene: Scene::with(model, &settings),
        shapes: HeldShapes::new(model, &[patch]).unwrap().map(Arc::new),
        guest_has_shapes,
        felt: Vec::new(),
        columns: Vec::new(),
        of_host: Vec::new(),
    };
    assert!(watch.shapes.is_some());
    watch.scene.hand = hand(corner);
    let path = PathConfig::symmetric(LinkConfig::preset(preset));
    for seed in [3, 4] {
        pair.join_with(GuestSessionConfig::default(), path.clone(), seed, cached(model)).unwrap();
    }
    pair.run_until(16 * S, &mut watch);
    assert!(watch.scene.body.held_shapes().is_some());
    let truth = &watch.scene.reactions;
    let user = truth.last().expect("a hand").1.user;
    let of = |tick: u64| truth.iter().find(|(t, key, _)| *t == tick && *key == GrabKey { user, ..*key });
    let (mut sum, mut largest, mut count) = (0.0, 0.0f64, 0);
    for (tick, felt) in &watch.felt {
        let Some((_, _, right)) = of(*tick) else { continue };
        sum += felt.iter().zip(right).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        largest = largest.max(right.iter().map(|x| x * x).sum::<f64>());
        count += 1;
    }
    assert!(count > 200 && user != UserId(0), "{count} reactions compared");
    let force = (sum / f64::from(count) / largest).sqrt();
    let (mut sum, mut largest, mut count) = (0.0, 0.0f64, 0);
    for (tick, s) in &watch.columns {
        let Some((_, right)) = watch.of_host.iter().find(|(t, s)| t == tick && !s.is_empty()) else {
            continue;
        };
        sum += s.iter().zip(right).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        largest = largest.max(right.iter().map(|x| x * x).sum::<f64>());
        count += 1;
    }
    assert!(!guest_has_shapes || count > 200, "{count} shapes compared");
    [force, (sum / f64::from(count.max(1)) / largest.max(1e-300)).sqrt()]
}

#[test]
fn guests_show_the_columns_that_the_host_has() {
    let (model, corner) = bar();
    for (preset, most) in [(Preset::Paper4, 0.03), (Preset::Paper1, 0.1)] {
        let without = run(&model, corner, preset, false);
        let with = run(&model, corner, preset, true);
        println!(
            "{}: the columns that are shown are off by {:.2} %, the predicted reaction by {:.2} % \
             (without shapes {:.2} %)",
            preset.name(),
            100.0 * with[1],
            100.0 * with[0],
            100.0 * without[0]
        );
        // Shapes are only shown. The predicted steps go without them.
        assert!(with[0] == without[0] && with[0] < 0.05, "{with:?} {without:?}");
        assert!(with[1] < most, "{with:?}");
    }
}

//! Guests show the own shapes of the patch that a hand holds as the host has them.

use crate::support;

use std::sync::Arc;
use std::time::Duration;

use pliant_bake::{BakeConfig, Material, bake};
use pliant_lab::pair::{Pair, PathConfig, World};
use pliant_mesh::shapes;
use pliant_modal::{Elasticity, GrabConfig, HeldPlace, HeldShapes, ModalModel, Patch, StepSettings};
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
    /// From when on reactions and columns are compared.
    from: Duration,
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
            && now > self.from
            && let Some(predicted) = view.predicted_hand()
        {
            self.felt.extend(predicted.reaction(1).or(predicted.reaction(0)).map(|f| (predicted.tick(), f)));
        }
        // The second guest only watches.
        if guest == 1
            && now > self.from
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

/// Leads a vertex by `way` (m) in a second, holds it there for three seconds, and so on with the
/// way back.
fn come_and_go(vertex: u32, from: [f64; 3], way: [f64; 3]) -> HandScript {
    let mut grab = None;
    Box::new(move |now, guest, session| {
        if guest != 0 || session.user().is_none() {
            return;
        }
        let t = (now.as_secs_f64() - 2.0).max(0.0) % 8.0;
        let share = (t.min(1.0) - (t - 4.0).clamp(0.0, 1.0)).clamp(0.0, 1.0);
        let share = share * share * (3.0 - 2.0 * share);
        let target = std::array::from_fn(|k| from[k] + share * way[k]);
        match grab {
            None => grab = session.begin_grab(now, BODY, vertex, RADIUS, target, GrabConfig::default()).ok(),
            Some(g) => session.set_target(g, target).unwrap(),
        }
    })
}

/// Returns the error of the predicted reaction, root mean square, as a share of the largest, and
/// the same of the columns that a guest shows who only watches. Compared from `from` on.
fn run(
    model: &Arc<ModalModel>,
    shapes: &Option<Arc<HeldShapes>>,
    hand: HandScript,
    from: Duration,
    preset: Preset,
    guest_has_shapes: bool,
) -> [f64; 2] {
    let settings =
        StepSettings { elasticity: Elasticity::Reduced, damping_scale: 10.0, ..Default::default() };
    let mut pair = Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), settings).unwrap();
    let mut watch = Watch {
        scene: Scene::with(model, &settings),
        shapes: shapes.clone(),
        guest_has_shapes,
        from,
        felt: Vec::new(),
        columns: Vec::new(),
        of_host: Vec::new(),
    };
    assert!(watch.shapes.is_some());
    watch.scene.hand = hand;
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
    let patch = Patch::around(model.surface(), corner, RADIUS).unwrap();
    let shapes = HeldShapes::new(&model, &[patch]).unwrap().map(Arc::new);
    for (preset, most) in [(Preset::Paper4, 0.03), (Preset::Paper1, 0.1)] {
        let [without, with] =
            [false, true].map(|with| run(&model, &shapes, hand(corner), 6 * S, preset, with));
        println!(
            "{}: the columns that are shown are off by {:.2} %, the predicted reaction by {:.2} % \
             (without shapes {:.2} %)",
            preset.name(),
            100.0 * with[1],
            100.0 * with[0],
            100.0 * without[0]
        );
        assert!(with[0] < without[0] && with[0] < 0.05, "{with:?} {without:?}");
        assert!(with[1] < most, "{with:?}");
    }
}

/// A hand at the corner of the end, and one on the upper side of the middle that presses.
#[test]
fn a_guest_feels_in_its_hand_what_the_host_steps() {
    let (model, corner) = bar();
    let at = |place: [f32; 3]| model.surface().positions().iter().position(|p| *p == place).unwrap() as u32;
    let middle = at([0.5, 0.1, 0.05]);
    for (name, vertex, from, way) in [
        ("pulled", corner, [1.0, 0.1, 0.1], [0.0, 0.06, 0.053]),
        ("pressed", middle, [0.5, 0.1, 0.05], [0.0, -0.08, 0.0]),
    ] {
        let place = HeldPlace { vertex, radius: RADIUS, displacement: way };
        let shapes = HeldShapes::of_places(&model, &[place]).unwrap().map(Arc::new);
        for preset in [Preset::Paper1, Preset::Wifi, Preset::Paper4] {
            let [without, with] = [false, true].map(|with| {
                let hand = come_and_go(vertex, from, way);
                run(&model, &shapes, hand, 3 * S, preset, with)[0]
            });
            println!(
                "{name}, {}: the predicted reaction is off by {:.2} %, without shapes by {:.2} %",
                preset.name(),
                100.0 * with,
                100.0 * without
            );
            assert!(with < without, "{with} {without}");
        }
    }
}

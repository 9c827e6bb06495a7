//! Whole sessions over emulated paths, checked against the bounds of the design: 40 Hz, 120 modes.
//!
//! `cargo test -p pliant_lab --test suite measure:: -- --ignored --nocapture` runs the long form:
//! ten minutes, many seeds and all policies.

use crate::support;

use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use pliant_lab::experiment::{Experiment, Metrics};
use pliant_modal::{Integrator, ModalModel};
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::peer::LateInputRepair;
use pliant_stream::wire::AccelerationCoding;
use pliant_stream::{Newmark, Predict, RecoveryConfig};
use support::{bar, loose_bar};

fn paper1(loss: Loss) -> LinkConfig {
    LinkConfig { loss, ..LinkConfig::preset(Preset::Paper1) }
}

/// Bounds of the default policy on a network, percent but for the last two.
#[derive(Clone, Copy)]
struct Bars {
    /// Shape's error, root mean square and largest.
    rms: f64,
    max: f64,
    /// Reactions' error, root mean square.
    reactions: f64,
    /// Ringing of the shown reactions, as a multiple of that of the true ones.
    ringing: f64,
    /// Number of ticks whose data came too late.
    too_late: u64,
}

/// A network of the design and its bounds.
struct Condition {
    name: &'static str,
    link: LinkConfig,
    /// For a minute. The result is the same on each run, so that the bounds are a little above it.
    minute: Bars,
    /// For the worst of a hundred sessions of ten minutes.
    many: Bars,
    /// For the shape's error in the median one of them, rms %, and for the ticks that come too late
    /// in a mean one. These do not depend on the number of sessions.
    typical: [f64; 2],
}

fn conditions() -> [Condition; 4] {
    let bars = |rms, max, reactions, ringing, too_late| Bars { rms, max, reactions, ringing, too_late };
    let of = |name, link, minute, many, typical| Condition { name, link, minute, many, typical };
    let tick = Duration::from_millis(25);
    [
        of(
            "paper-1",
            LinkConfig::preset(Preset::Paper1),
            bars(0.065, 1.3, 0.3, 1.01, 0),
            bars(0.07, 1.6, 0.3, 1.01, 0),
            [0.056, 0.0],
        ),
        of(
            "burst:12",
            paper1(Loss::Burst { first: 140, count: 12 }),
            bars(0.065, 3.6, 0.18, 1.01, 0),
            bars(0.021, 3.6, 0.055, 1.01, 0),
            [0.021, 0.0],
        ),
        // Blackouts of 20 ticks and more occur in ten minutes. After one, the removal of the error
        // of the extrapolated force shows in the reaction, and some data comes too late.
        of(
            "gilbert:4",
            paper1(Loss::gilbert(0.09, 4.0, tick)),
            bars(0.35, 10.0, 1.0, 1.01, 0),
            bars(0.5, 66.0, 3.6, 2.3, 24),
            [0.28, 2.5],
        ),
        of(
            "every:50",
            paper1(Loss::Every { first: 135, every: 50 }),
            bars(0.0013, 0.009, 5e-4, 1.01, 0),
            bars(0.0013, 0.009, 5e-4, 1.01, 0),
            [0.0013, 0.0],
        ),
    ]
}

/// The bar, or the model file that the variable MODEL names.
fn body() -> Arc<ModalModel> {
    static BODY: OnceLock<Arc<ModalModel>> = OnceLock::new();
    let made = || match std::env::var("MODEL") {
        Ok(path) => Arc::new(ModalModel::read(path).unwrap()),
        Err(_) => bar(120, 0.05),
    };
    BODY.get_or_init(made).clone()
}

fn run(link: &LinkConfig, policy: &str, seconds: f64, seed: u64) -> Metrics {
    let mut e = Experiment::new(body(), link.clone(), RecoveryConfig::by_name(policy).unwrap());
    (e.seconds, e.seed) = (seconds, seed);
    e.cpu_clock = Some(clock);
    e.run().unwrap()
}

fn run_peers(link: &LinkConfig, repair: LateInputRepair, seconds: f64) -> Metrics {
    let mut e = Experiment::new(body(), link.clone(), RecoveryConfig::default());
    e.seconds = seconds;
    e.cpu_clock = Some(clock);
    e.run_peers(repair).unwrap()
}

fn clock() -> Duration {
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed()
}

fn show(name: &str, f: &Metrics) {
    println!(
        "{name:<26} lost {:>4} guessed {:>4} rms {:.4}% max {:.3}% end {:.1e}% confirmed {:.1e}% force {:.3}% ringing {:.4} (true {:.4}) \
         delay {:.0} ms hand-force {:.0} ms recover {:.0} ms {:.0} B {:.1} kbit/s {:.1} us/tick",
        f.lost,
        f.guessed,
        f.rms_percent,
        f.max_percent,
        f.end_percent,
        f.confirmed_end_percent,
        f.force_rms_percent,
        f.force_ringing,
        f.true_ringing,
        f.visual_delay_ms,
        f.hand_to_force_ms,
        f.recover_ms,
        f.bytes_per_frame,
        f.kbit_s,
        f.cpu_us_per_tick
    );
}

/// What is above its bound.
fn above(bars: &Bars, f: &Metrics) -> Vec<String> {
    let all = [
        ("rms %", f.rms_percent, bars.rms),
        ("max %", f.max_percent, bars.max),
        ("reactions %", f.force_rms_percent, bars.reactions),
        // A change of sign in each step would give 4. (The scripted hands have a tremor, so the
        // true ringing is not 0 either.)
        ("ringing / true", f.force_ringing / f.true_ringing, bars.ringing),
        ("too late", f.counts.too_late as f64, bars.too_late as f64),
        ("kbit/s", f.kbit_s, 93.0),
    ];
    let missed = all.iter().filter(|(_, got, bar)| got.is_nan() || got > bar);
    missed.map(|(what, got, bar)| format!("{what}: {got} of {bar}")).collect()
}

#[test]
fn default_policy_holds_its_bars() {
    for Condition { name, link, minute, .. } in conditions() {
        for seed in 1..=2 {
            let f = run(&link, "default", 60.0, seed);
            show(name, &f);
            let missed = above(&minute, &f);
            assert!(missed.is_empty(), "{name}, seed {seed}: {missed:?}");
        }
    }
}

#[test]
fn burst_is_recovered_when_the_first_frame_arrives() {
    let mut e = Experiment::new(
        bar(120, 0.05),
        paper1(Loss::Burst { first: 140, count: 12 }),
        RecoveryConfig::default(),
    );
    (e.seconds, e.keep_track) = (20.0, true);
    let f = e.run().unwrap();
    // The predicted ticks end where the first frame after the burst arrives. After that, the
    // position of the hand's patch shows the error.
    let scale = f.track.iter().map(|t| t.displacement[0].abs()).fold(0.0, f64::max);
    let wrong = f.track.iter().filter(|t| (t.displacement[0] - t.displacement[1]).abs() > 0.005 * scale);
    let off: Vec<u64> = wrong.map(|t| t.tick).collect();
    let (Some(first), Some(last)) = (off.first(), off.last()) else { panic!("the burst does not show") };
    // Twelve ticks are lost. One tick of playout delay and three repeats leave at most nine
    // predicted ticks.
    let after = (last - first) as f64 * 25.0 - 12.0 * 25.0;
    println!("{} ticks are off, the last {after} ms after the first arrival", off.len());
    // The blend of six ticks hides what arrives, so that the last wrong tick at the hand is before
    // the first arrival. One tick later would be a tick of playout delay lost.
    assert!(after <= -100.0 && off.len() <= 7, "{after} ms after the first arrival: {first} to {last}");
}

#[test]
fn peers_see_one_shape_over_the_papers_worst_network() {
    let link = LinkConfig::preset(Preset::Paper1);
    let f = run_peers(&link, LateInputRepair::Rollback, 30.0);
    show("p2p rollback", &f);
    // 30 s at 40 Hz, without the last ones, on which nobody agrees yet.
    assert!((1170..=1200).contains(&f.ticks) && f.missing == 0, "{} ticks, {} missing", f.ticks, f.missing);
    assert!(f.rms_percent < 0.3 && f.max_percent < 1.8, "rms {} %, max {} %", f.rms_percent, f.max_percent);
    assert!(f.force_rms_percent < 3.0, "reactions {} %", f.force_rms_percent);
    // The own hand is felt in the next step. Its position is set every 5 ms, so that the oldest one
    // that a step of 25 ms answers is 20 ms old.
    assert!((15.0..=25.0).contains(&f.hand_to_force_ms), "{} ms", f.hand_to_force_ms);
    // The path takes 98 ms, an application looks every 5 ms, and what is lost is repeated in the
    // next datagrams.
    assert!((98.0..108.0).contains(&f.visual_delay_ms), "{} ms", f.visual_delay_ms);
    assert_eq!(f.hash, run_peers(&link, LateInputRepair::Rollback, 30.0).hash, "same seed, same session");
}

#[test]
fn same_seed_same_hash() {
    let link = LinkConfig::preset(Preset::Paper1);
    let go = |seed| run(&link, "default", 5.0, seed).hash;
    assert_eq!(go(7), go(7));
    assert_ne!(go(7), go(8));
}

/// The paper's figures 7 to 9: losses are resent 50 ticks later and blended over 1 and 50 ticks.
#[test]
fn papers_figures_end_without_error() {
    let random: Vec<u64> = (0..22_u64).map(|k| 135 + (k * 7919) % 300).collect();
    let losses = [
        ("22 random", {
            let mut r = random;
            r.sort_unstable();
            r.dedup();
            Loss::Listed(r)
        }),
        ("12 in a row", Loss::Burst { first: 140, count: 12 }),
        ("one in 50", Loss::Every { first: 135, every: 50 }),
    ];
    for (name, loss) in losses {
        for predict in [Predict::Zero, Predict::Hold, Predict::Linear] {
            for blend in [1, 50] {
                let mut recovery = RecoveryConfig::paper_with(predict, blend);
                recovery.coding = AccelerationCoding::F64;
                // The paper's system uses average acceleration at both ends, so that its
                // accelerations are the streamed ones.
                let link =
                    LinkConfig { delay: Duration::from_millis(10), loss: loss.clone(), ..Default::default() };
                let mut e = Experiment::new(bar(20, 0.05), link, recovery);
                e.integrator = Integrator::Newmark;
                e.newmark = Newmark::average(0.025);
                e.resend_after = Duration::from_secs_f64(50.0 * 0.025);
                e.seconds = 18.0;
                if name == "one in 50" {
                    // Eleven losses leave time to repair the last.
                    e.down.loss = Loss::Listed((0..11).map(|k| 135 + 50 * k).collect());
                }
                let f = e.run().unwrap();
                show(&format!("{name} {predict:?} {blend}"), &f);
                assert!(f.counts.guessed >= 10, "{name}: {:?}", f.counts);
                assert_eq!(f.counts.guessed, f.counts.repaired);
                assert!(f.end_percent < 1e-7, "{name} {predict:?} {blend}: ends at {} %", f.end_percent);
            }
        }
        let mut e = Experiment::new(
            bar(20, 0.05),
            LinkConfig { delay: Duration::from_millis(10), loss, ..Default::default() },
            RecoveryConfig { coding: AccelerationCoding::F64, ..RecoveryConfig::none() },
        );
        (e.integrator, e.newmark, e.seconds) = (Integrator::Newmark, Newmark::average(0.025), 18.0);
        let f = e.run().unwrap();
        assert!(f.end_percent > 1.0, "{name}: without compensation the error stays: {} %", f.end_percent);
    }
}

/// A way of repair with the default's repeats and playout delay. A stream of accelerations has the
/// paper's integrator at both ends.
fn repaired_as(recovery: RecoveryConfig, link: &LinkConfig) -> Experiment {
    let RecoveryConfig { repeats, playout, .. } = RecoveryConfig::default();
    let mut e = Experiment::new(body(), link.clone(), RecoveryConfig { repeats, playout, ..recovery });
    e.use_the_papers_integrator();
    e
}

/// Many sessions of one way of repair.
struct Many {
    /// The worst of each metric, and of the ticks that came too late in a session.
    worst: Metrics,
    /// The shape's error, rms % by seed.
    rms: Vec<f64>,
    /// Ticks that came too late, mean of the sessions.
    too_late: f64,
}

impl Many {
    fn median_rms(&self) -> f64 {
        let mut sorted = self.rms.clone();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    }
}

/// An experiment with the seeds 1 to `seeds`, two at a time.
fn many(e: &Experiment, seeds: u64) -> Many {
    let next = std::sync::atomic::AtomicU64::new(1);
    let all = std::sync::Mutex::new(vec![Metrics::default(); seeds as usize]);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    if seed > seeds {
                        return;
                    }
                    let f = Experiment { seed, ..e.clone() }.run().unwrap();
                    all.lock().unwrap()[seed as usize - 1] = f;
                }
            });
        }
    });
    let all = all.into_inner().unwrap();
    let mut w = Metrics::default();
    for f in &all {
        w.rms_percent = w.rms_percent.max(f.rms_percent);
        w.max_percent = w.max_percent.max(f.max_percent);
        w.recover_ms = w.recover_ms.max(f.recover_ms);
        w.kbit_s = w.kbit_s.max(f.kbit_s);
        w.kbit_s_up = w.kbit_s_up.max(f.kbit_s_up);
        w.force_rms_percent = w.force_rms_percent.max(f.force_rms_percent);
        w.force_ringing = w.force_ringing.max(f.force_ringing);
        w.true_ringing = w.true_ringing.max(f.true_ringing);
        w.visual_delay_ms = w.visual_delay_ms.max(f.visual_delay_ms);
        w.counts.too_late = w.counts.too_late.max(f.counts.too_late);
    }
    let too_late = all.iter().map(|f| f.counts.too_late as f64).sum::<f64>() / seeds as f64;
    Many { worst: w, rms: all.iter().map(|f| f.rms_percent).collect(), too_late }
}

/// The paper's prediction and blend, and those of its six ways (three predictions, in 1 and in 50
/// steps) that are nearest to the truth here, on two seeds of ten minutes.
const PAPERS: [(&str, Predict, u16); 2] =
    [("paper", Predict::Linear, 50), ("paper-zero, 1 step", Predict::Zero, 1)];

/// All ways have the same repeats, the same playout delay and the same seeds.
#[test]
#[ignore = "minutes: the long form of the bars"]
fn default_policy_holds_its_bars_for_ten_minutes_on_many_seeds() {
    let number =
        |name: &str, default: f64| std::env::var(name).ok().and_then(|s| s.parse().ok()).unwrap_or(default);
    let (seeds, seconds) = (number("SEEDS", 100.0) as u64, number("SECONDS", 600.0));
    println!("{seeds} seeds of {seconds} s each");
    println!(
        "| network | policy | rms %, worst | median | max % | longest above 0.5 % | reactions rms % | \
         ringing (true) | kbit/s down | up | delay ms | too late, worst | mean | times the default's rms |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    let line = |name: &str, policy: &str, all: &Many, times: &str| {
        let f = &all.worst;
        println!(
            "| {name} | {policy} | {:.4} | {:.4} | {:.3} | {:.0} ms | {:.3} | {:.4} ({:.4}) | {:.1} | {:.1} | \
             {:.0} | {} | {:.2} | {times} |",
            f.rms_percent,
            all.median_rms(),
            f.max_percent,
            f.recover_ms,
            f.force_rms_percent,
            f.force_ringing,
            f.true_ringing,
            f.kbit_s,
            f.kbit_s_up,
            f.visual_delay_ms,
            f.counts.too_late,
            all.too_late,
        );
    };
    let mut missed = Vec::new();
    for Condition { name, link, many: bars, typical: [median, mean_too_late], .. } in conditions() {
        // The rarest blackout of a hundred sessions is not among twenty.
        let bars = if seeds <= 20 { Bars { max: bars.max.min(45.0), ..bars } } else { bars };
        // Losses that are scheduled are the same in every session.
        let seeds = match link.loss {
            Loss::Random(_) | Loss::GilbertElliott { .. } => seeds,
            _ => 1,
        };
        let of = |recovery| {
            let e = Experiment { seconds, ..repaired_as(recovery, &link) };
            many(&e, seeds)
        };
        let ours = of(RecoveryConfig::default());
        line(name, "default", &ours, "1");
        for (policy, predict, blend) in PAPERS {
            let paper = of(RecoveryConfig::paper_with(predict, blend));
            let mut times: Vec<f64> =
                paper.rms.iter().zip(&ours.rms).map(|(paper, ours)| paper / ours).collect();
            times.sort_by(f64::total_cmp);
            let [least, middle, most] = [0, times.len() / 2, times.len() - 1].map(|k| times[k]);
            line(name, policy, &paper, &format!("{middle:.2} ({least:.2} to {most:.2})"));
        }
        missed.extend(above(&bars, &ours.worst).into_iter().map(|miss| format!("{name}: {miss}")));
        for (what, got, bar) in
            [("median rms %", ours.median_rms(), median), ("mean too late", ours.too_late, mean_too_late)]
        {
            if got.is_nan() || got > bar {
                missed.push(format!("{name}: {what}: {got} of {bar}"));
            }
        }
    }
    assert!(missed.is_empty(), "{missed:?}");
}

#[test]
#[ignore = "a minute: an hour of streaming"]
fn an_hour_does_not_drift() {
    let short = run(&LinkConfig::preset(Preset::Paper1), "default", 120.0, 1);
    let long = run(&LinkConfig::preset(Preset::Paper1), "default", 3600.0, 1);
    show("two minutes", &short);
    show("one hour", &long);
    assert!(long.rms_percent < 1.5 * short.rms_percent);
    assert!(long.confirmed_end_percent < 0.02, "{} %", long.confirmed_end_percent);
}

#[test]
#[ignore = "a minute: all policies side by side"]
fn all_policies_side_by_side() {
    let perfect = ("perfect", LinkConfig { delay: Duration::from_millis(20), ..Default::default() });
    let lossy = conditions().map(|condition| (condition.name, condition.link));
    for (network, link) in std::iter::once(perfect).chain(lossy) {
        println!("== {network}");
        for policy in RecoveryConfig::NAMES {
            show(policy, &run(&link, policy, 60.0, 1));
        }
        for (name, repair) in
            [("p2p rollback", LateInputRepair::Rollback), ("p2p compensated", LateInputRepair::Compensate)]
        {
            show(name, &run_peers(&link, repair, 60.0));
        }
    }
}

/// The tick of a grab or release is lost together with its neighbors. No forecast predicts the
/// change, so the host sends it several times.
#[test]
fn a_lost_release_or_grab_makes_no_spike() {
    for (what, holds) in [("release", (0.0, 8.0)), ("grab", (8.0, 1e9))] {
        for (count, bar) in [(1, 0.5), (2, 2.0), (3, 2.0)] {
            let (mut worst, mut at) = (0.0_f64, 0);
            // Try all datagrams around that moment, because the one that carries the change is not
            // known.
            for first in 164..=184 {
                let link = paper1(Loss::Listed((first..first + count).collect()));
                let mut e = Experiment::new(body(), link, RecoveryConfig::default());
                e.seconds = 6.0;
                e.hands[1].holds = Some(holds);
                let f = e.run().unwrap();
                (worst, at) = if f.max_percent > worst { (f.max_percent, first) } else { (worst, at) };
            }
            println!("{what}, {count} datagrams lost: at worst {worst:.2} %, from datagram {at}");
            assert!(worst < bar, "{what}, {count} lost from {at}: {worst} %");
        }
    }
}

/// Measures the cost of one body per tick with 120 modes, two hands and 9 % of the frames lost and
/// requested again: the host's encoder, and a guest's decoding, correcting and stepping. Run with
/// `--release`.
#[test]
#[ignore = "a timing: means something with --release only"]
fn cost_of_a_tick() {
    use pliant_modal::{Body, BodyConfig, GrabConfig, Patch};
    use pliant_stream::codec::encoder::Encoder;
    use pliant_stream::recovery::Receiver;
    use pliant_stream::wire::Datagram;
    use pliant_stream::{BodyId, GrabKey, GrabState, StepSettings, TickState, UserId};
    let model = body();
    let h = 0.025;
    let newmark = Newmark { h, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 };
    for policy in ["default", "paper"] {
        let recovery = RecoveryConfig::by_name(policy).unwrap();
        let mut truth = Body::new(model.clone(), BodyConfig { step: h, ..Default::default() }).unwrap();
        let hands = Experiment::default_hands(&model);
        let held: Vec<_> = hands
            .iter()
            .map(|x| {
                let patch = Patch::around(model.surface(), x.vertex, x.radius).unwrap();
                let id = truth.grab(&patch, GrabConfig::default()).unwrap();
                (id, truth.grab_position(id).unwrap())
            })
            .collect();
        let (id, settings) = (BodyId(1), StepSettings::default());
        let mut encoder =
            Encoder::new(id, model.clone(), &settings, newmark, recovery.subscription(None), 1200).unwrap();
        let mut receiver: Option<Receiver> = None;
        let (mut encode, mut decode) = (Vec::new(), Vec::new());
        let mut chance = 88_172_645_463_325_252;
        // Lost frames arrive again 8 ticks later, after a round trip of the paper's network.
        let mut lost = std::collections::VecDeque::new();
        for tick in 1..=2000_u64 {
            let t = tick as f64 * h;
            for ((id, start), hand) in held.iter().zip(&hands) {
                let d = hand.path(t);
                truth.set_target(*id, std::array::from_fn(|k| start[k] + d[k])).unwrap();
            }
            truth.step().unwrap();
            let grabs: Vec<GrabState> = held
                .iter()
                .zip(&hands)
                .enumerate()
                .map(|(k, ((id, _), hand))| GrabState {
                    key: GrabKey { user: UserId(k as u16), grab: 0 },
                    vertex: hand.vertex,
                    radius: hand.radius,
                    target: truth.target(*id).unwrap(),
                    reaction: truth.reaction(*id).unwrap(),
                    hold: GrabConfig::default(),
                })
                .collect();
            let (q, v, a) = (truth.q(), truth.v(), truth.a());
            let state = TickState { tick, q, v, a, z: &[], pose: None, grabs: &grabs, resting: false };
            if receiver.is_none() {
                encoder.restart(&state);
                let snapshot = encoder.snapshot(false);
                let modes = encoder.modes();
                receiver = Some(
                    Receiver::new(model.clone(), settings, modes, newmark, &recovery, &snapshot).unwrap(),
                );
                continue;
            }
            let receiver = receiver.as_mut().unwrap();
            let began = Instant::now();
            let body = encoder.encode(&state);
            encode.push(began.elapsed());
            let wrap = |body: &[u8]| [&[1, 0, 0], body].concat();
            let mut arrived = Vec::new();
            if lost.front().is_some_and(|at| at + 8 <= tick) {
                arrived
                    .extend(lost.pop_front().into_iter().flat_map(|at| encoder.resend(at)).map(|b| wrap(&b)));
            }
            if support::random(&mut chance) % 100 < 9 {
                lost.push_back(tick);
            } else {
                arrived.push(wrap(&body.first));
            }
            let began = Instant::now();
            for bytes in &arrived {
                let Datagram::Frame(frame) = Datagram::decode(bytes).unwrap().1 else { unreachable!() };
                receiver.accept(&frame);
            }
            receiver.advance();
            decode.push(began.elapsed());
        }
        let counts = receiver.as_ref().unwrap().counts();
        assert!(counts.repaired > 50, "there must have been something to put right: {counts:?}");
        let median = |times: &mut Vec<Duration>| {
            times.sort_unstable();
            times[times.len() / 2].as_secs_f64() * 1e6
        };
        println!(
            "{policy}: encode {:.1} us, decode and step {:.1} us a tick",
            median(&mut encode),
            median(&mut decode)
        );
    }
}

#[test]
fn what_is_not_shown_counts_as_missing_and_as_wrong() {
    let link = |loss| LinkConfig { loss, delay: Duration::from_millis(10), ..LinkConfig::default() };
    let whole = run(&link(Loss::None), "default", 10.0, 1);
    assert!(whole.missing == 0 && whole.ticks >= 399 && whole.max_percent < 0.1, "{whole:?}");
    // No frame arrives. After a bit more than a second of prediction the visual state stands still,
    // and every later tick counts as missed and is compared.
    let none = run(&link(Loss::Burst { first: 0, count: 100_000 }), "default", 10.0, 1);
    assert!(none.missing > 300 && none.ticks + none.missing >= 398, "{none:?}");
    assert!(none.rms_percent > 10.0 && none.end_percent > 1.0, "{none:?}");
    // A second without frames: some ticks are missed, and ticks that the catch-up skips do not
    // count as shown.
    let gap = run(&link(Loss::Burst { first: 100, count: 60 }), "default", 10.0, 1);
    assert!((5..=60).contains(&gap.missing) && gap.max_percent > 1.0, "{gap:?}");
    assert!(gap.ticks + gap.missing >= 398, "{gap:?}");
}

#[test]
fn a_free_body_is_measured_with_its_pose() {
    let link = |loss| LinkConfig { loss, delay: Duration::from_millis(10), ..LinkConfig::default() };
    let run = |loss| {
        let mut e = Experiment::new(loose_bar(20, 0.05), link(loss), RecoveryConfig::default());
        e.seconds = 10.0;
        let reach = e.hands[0].reach.iter().copied().fold(0.0, f64::max);
        (e.run().unwrap(), reach, e)
    };
    let (whole, reach, e) = run(Loss::None);
    show("free", &whole);
    assert!(whole.scale > 0.5 * reach, "{} m of {reach} m", whole.scale);
    assert!(whole.max_percent < 0.1, "{whole:?}");
    // Without frames the picture stays where it was, while the hands carry the body away: at the
    // end it is far off. Its modal coordinates alone differ by 8 % there.
    let (none, ..) = run(Loss::Burst { first: 0, count: 100_000 });
    show("free, no frames", &none);
    assert!(none.end_percent > 50.0, "{} %", none.end_percent);
    for repair in [LateInputRepair::Rollback, LateInputRepair::Compensate] {
        let f = e.run_peers(repair).unwrap();
        show("free, peers", &f);
        assert!(f.scale > 0.5 * reach && f.missing == 0, "{} m of {reach} m", f.scale);
        // Each hand is 10 ms away, and a hand moves by less than a tenth of its reach meanwhile.
        assert!((1e-4..5.0).contains(&f.rms_of_motion_percent), "{} %", f.rms_of_motion_percent);
    }
}

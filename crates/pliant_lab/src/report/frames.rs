//! Error and size of quantized frames, and the data sent over the paper's networks.

use std::{fmt::Write, sync::Arc};

use pliant_mesh::shapes;
use pliant_modal::{Element, ModalModel};
use pliant_stream::{
    Playout, RecoveryConfig,
    emulator::{LinkConfig, Preset},
    peer::LateInputRepair,
};

use super::{
    plot::{Axes, Figure, Series},
    work::{anchor, baked, config},
};
use crate::{
    LabError,
    experiment::{Experiment, Metrics},
    progress::Progress,
};

/// Steps a second, as in the paper.
const RATE: f64 = 40.0;

/// A bar with as many modes as the paper's largest row.
fn bar() -> Result<Arc<ModalModel>, LabError> {
    let mesh = shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?;
    Ok(baked(&mesh, &config(Element::Tet10, 120, vec![anchor(0, 1e-9)]))?.0)
}

fn experiment(model: &Arc<ModalModel>, link: LinkConfig, recovery: RecoveryConfig) -> Experiment {
    let mut made = Experiment::new(model.clone(), link, recovery);
    made.use_the_papers_integrator();
    made
}

fn bytes_a_tick(kbit_s: f64) -> f64 {
    kbit_s * 1e3 / 8.0 / RATE
}

/// The error from the size of the quantization steps alone, without any loss.
pub(super) fn quantized(quick: bool, progress: &mut dyn Progress) -> Result<Figure, LabError> {
    let powers: &[i32] = if quick { &[4, 8, 14, 20] } else { &[4, 6, 8, 10, 12, 14, 16, 18, 20, 24] };
    let model = bar()?;
    let mut series = Vec::new();
    let mut words = "A quantum is the displacement of the surface by one step of a quantized number, as a share of the deformation of the body. From left to right it is 2^-4 to 2^-20 and finer (default 2^-14; streams of accelerations use a 64th of it). There is no loss, and there are 120 modes, two hands and 40 steps a second. A stream of reactions rounds only the slices that refresh it, so the quantum matters little there. A stream of accelerations rounds every number that it sends, in a closed loop, so the rounding errors do not add up. At the default:"
        .to_owned();
    for (done, name) in ["default", "paper"].into_iter().enumerate() {
        let recovery = RecoveryConfig::by_name(name).unwrap_or_default();
        let mut points = Vec::new();
        let mut made = experiment(&model, LinkConfig::preset(Preset::Paper4), recovery);
        made.seconds = if quick { 10.0 } else { 30.0 };
        for (index, &power) in powers.iter().enumerate() {
            progress.report("frames", 0.5 * (done as f64 + index as f64 / powers.len() as f64));
            made.quantum = 2.0f64.powi(-power);
            let f = made.run()?;
            points.push((bytes_a_tick(f.kbit_s), f.rms_percent.max(1e-9)));
            if power == 14 {
                let _ = write!(
                    words,
                    " `{name}` {:.0} bytes a tick, rms {:.1e} %;",
                    bytes_a_tick(f.kbit_s),
                    f.rms_percent
                );
            }
        }
        series.push(Series::new(name, points));
    }
    words.pop();
    words.push('.');
    Ok(Figure {
        file: "e-frames".into(),
        title: "Quantized frames: how coarse they may be".into(),
        x: "down, bytes a tick".into(),
        y: "shown error, rms, % of the largest displacement".into(),
        axes: Axes::Logarithmic,
        series,
        reference_error: None,
        words,
        below: None,
    })
}

/// The paper's networks with their loss and bandwidth, and the bytes sent beside the paper's
/// numbers.
pub(super) fn table_3(quick: bool, progress: &mut dyn Progress) -> Result<String, LabError> {
    // Loss in % and bandwidth in Mb/s are the paper's. Except for the first network, the paper
    // gives the round trip only in a figure.
    const PAPER: [(Preset, f64, f64, &str); 4] = [
        (Preset::Paper1, 9.0, 2.0, "196"),
        (Preset::Paper2, 6.0, 4.0, "120 (assumed)"),
        (Preset::Paper3, 3.0, 10.0, "60 (assumed)"),
        (Preset::Paper4, 0.0, 100.0, "20 (assumed)"),
    ];
    let mut out = "| network | loss % | Mb/s | round trip ms | repair | down, bytes a tick (paper: 2,000-3,000) | up with a hand, bytes a tick (paper: 1,000-2,000) | of the bandwidth % | frames lost | shown error rms / largest % | rms / rms of the motion % | reaction rms % | rms / rms of the force % | ticks missing | delay, ticks | repeats |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n".to_owned();
    let model = bar()?;
    for (done, (preset, loss, megabits, trip)) in PAPER.into_iter().enumerate() {
        for name in ["paper", "paper-zero", "paper, alpha", "paper-zero, alpha", "default", "peers, rollback"]
        {
            progress.report("table 3", done as f64 / 4.0);
            let (policy, alpha) = match name.strip_suffix(", alpha") {
                Some(policy) => (policy, true),
                None => (name, false),
            };
            let recovery = RecoveryConfig::by_name(policy).unwrap_or_default();
            let mut made = experiment(&model, LinkConfig::preset(preset), recovery);
            if alpha {
                made.use_our_integrator();
            }
            made.seconds = if quick { 20.0 } else { 60.0 };
            let (Playout::Fixed(delay) | Playout::Adaptive(delay)) = recovery.playout;
            // Peers have repeats of their own, and no playout.
            let (delay, repeats) = if name.starts_with("peers") {
                (0, made.peer_repeats)
            } else {
                (delay, usize::from(recovery.repeats))
            };
            let (f, up): (Metrics, f64) = if name.starts_with("peers") {
                let f = made.run_peers(LateInputRepair::Rollback)?;
                let up = f.kbit_s_up;
                (f, up)
            } else {
                let f = made.run()?;
                made.guest_hand = true;
                made.seconds = 10.0;
                (f, made.run()?.kbit_s_up)
            };
            let _ = writeln!(
                out,
                "| {} | {loss:.0} | {megabits:.0} | {trip} | {name} | {:.0} | {:.0} | {:.2} | {} of {} | {:.3} / {:.2} | {:.3} | {:.2} | {:.2} | {} | {delay} | {repeats} |",
                preset.name(),
                bytes_a_tick(f.kbit_s),
                bytes_a_tick(up),
                0.1 * (f.kbit_s + up) / megabits,
                f.lost,
                f.ticks,
                f.rms_percent,
                f.max_percent,
                f.rms_of_motion_percent,
                f.force_rms_percent,
                f.force_rms_of_force_percent,
                f.missing,
            );
        }
    }
    out.push_str(
        "\nThe body has 120 modes (the most in the paper's table 2), linear elasticity and two hands at the host, and the host takes 40 steps a second. The networks are emulated. This table covers the networks and the data sizes of the paper's table 3, but not every cell of it. The numbers in brackets in the column headers are from the paper's text. There are three differences. Our frames are quantized so that the quanta have equal effects on the surface, while the paper sends plain numbers. Our frames contain reactions instead of accelerations by default. A target is sent three times and not requested again. Errors are shares of the largest displacement and force, or of their rms where it says so. Bytes are those of the session, without those of UDP and QUIC (some 50 a datagram). The rows `paper` and `paper-zero` are the paper's recovery with our frames: `paper` with its linear prediction, and `paper-zero` with no prediction. Both have the paper's integrator, average acceleration, at both ends; the rows with `alpha` have generalized-alpha (`rho_inf` 0.5) at the host, which damps the fast modes and is what this library gives a stream of accelerations. None of these has the default's playout delay and repeats; part f compares the ways with the same delay and repeats. Over the same network figure 6 has far smaller errors of the paper's way, since its hands do not tremble. These do, by a two-thousandth of the size at 9.3 and 11.7 Hz, which no prediction follows; the body here also has twice as many modes, and its frames are quantized. Part f has each way with and without the tremor. The rows of the peers are the paper's other topology, in which both step the body and send only the targets of their hands: down is what the first sends and up what the second sends, each with one hand. Their error is that of the second before it knows all targets.\n",
    );
    Ok(out)
}

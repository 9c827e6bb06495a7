//! The table at the end of a run.

use crate::{guest::GuestReport, host::HostReport, meter::Meter, options::Options};

fn percentile(sorted: &[f64], part: f64) -> f64 {
    sorted.get(((sorted.len() as f64 - 1.0) * part).round().max(0.0) as usize).copied().unwrap_or(0.0)
}

pub fn print(options: &Options, host: &HostReport, you: &GuestReport, other: &GuestReport) {
    let mut step: Vec<f64> = host.step_us.iter().copied().collect();
    step.sort_by(f64::total_cmp);
    println!(
        "\nnetwork {}, recovery {}, seed {}, {:.1} s",
        options.network.name(),
        options.recovery.name(),
        options.seed,
        host.seconds
    );
    println!("{:<42}{:>12}{:>12}", "", "you", "other");
    let row = |name: &str, value: &dyn Fn(&GuestReport) -> String| {
        println!("{name:<42}{:>12}{:>12}", value(you), value(other));
    };
    row("ticks sent", &|_| host.ticks.to_string());
    row("ticks displayed", &|g| g.stats.displayed_ticks.to_string());
    row("ticks compared with the truth", &|g| g.meters.streamed.ticks.to_string());
    row("behind the host, ms", &|g| format!("{:.0}", 1e3 * g.meters.streamed.behind() / crate::RATE));
    row("datagrams lost on the way here, %", &|g| format!("{:.1}", 100.0 * g.stats.loss_in));
    row("ticks not there in time", &|g| g.stats.guessed.to_string());
    row("ticks corrected when their data arrived", &|g| g.stats.recovered.to_string());
    row("round trip, ms", &|g| format!("{:.0}", 1e3 * g.stats.round_trip.as_secs_f64()));
    row("bytes received a second", &|g| format!("{:.0}", g.stats.bytes_in as f64 / host.seconds.max(1e-9)));
    row("largest displacement, mm", &|g| format!("{:.1}", 1e3 * g.meters.streamed.largest));
    let errors = |name: &str, meter: &dyn Fn(&GuestReport) -> Meter| {
        row(&format!("{name}, rms, mm"), &|g| format!("{:.3}", 1e3 * meter(g).rms()));
        row(&format!("{name}, max, mm"), &|g| format!("{:.3}", 1e3 * meter(g).max));
        let percent = |meter: Meter, length: f64| format!("{:.3}", meter.percent(length));
        row(&format!("{name}, rms, % of largest"), &|g| percent(meter(g), meter(g).rms()));
        row(&format!("{name}, max, % of largest"), &|g| percent(meter(g), meter(g).max));
    };
    errors("streamed error", &|g| g.meters.streamed.clone());
    println!("while the local hand holds the body, against the later state of the host at the same tick:");
    errors("  predicted hand", &|g| g.meters.predicted_hand.clone());
    errors("  without prediction", &|g| g.meters.waiting.clone());
    row("largest reaction shown, N", &|g| format!("{:.2}", g.meters.reaction));
    let largest = |name| host.reactions.get(name).copied().unwrap_or(0.0);
    println!("{:<42}{:>12.2}{:>12.2}", "largest true reaction, N", largest("you"), largest("other"));
    println!(
        "host: time a step, us: median {:.1}, 99th percentile {:.1}; {:.0} bytes a second sent to both",
        percentile(&step, 0.5),
        percentile(&step, 0.99),
        host.bytes_out as f64 / host.seconds.max(1e-9)
    );
}

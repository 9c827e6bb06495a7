//! The table at the end.

use crate::{guest::GuestReport, host::HostReport, options::Options};

fn percentile(sorted: &[f64], part: f64) -> f64 {
    sorted.get(((sorted.len() as f64 - 1.0) * part).round().max(0.0) as usize).copied().unwrap_or(0.0)
}

pub fn print(options: &Options, host: &HostReport, you: &GuestReport, other: &GuestReport) {
    let mut step: Vec<f64> = host.step_us.iter().copied().collect();
    step.sort_by(f64::total_cmp);
    println!(
        "\nnetwork {} of the paper's, recovery {}, seed {}, {:.1} s",
        options.network,
        options.recovery.name(),
        options.seed,
        host.seconds
    );
    println!("{:<38}{:>14}{:>14}", "", "you", "other");
    let row = |name: &str, value: &dyn Fn(&GuestReport) -> String| {
        println!("{name:<38}{:>14}{:>14}", value(you), value(other));
    };
    row("ticks sent", &|_| host.ticks.to_string());
    row("ticks shown", &|g| g.stats.shown.to_string());
    row("ticks compared with the truth", &|g| g.meter.ticks.to_string());
    row("shown behind the host, ms", &|g| format!("{:.0}", 1e3 * g.meter.behind() / crate::RATE));
    row("datagrams lost on the way here, %", &|g| format!("{:.1}", 100.0 * g.stats.loss_in));
    row("ticks not there in time", &|g| g.stats.guessed.to_string());
    row("ticks put right when their data came", &|g| g.stats.recovered.to_string());
    row("round trip, ms", &|g| format!("{:.0}", 1e3 * g.stats.round_trip.as_secs_f64()));
    row("bytes received a second", &|g| format!("{:.0}", g.stats.bytes_in as f64 / host.seconds.max(1e-9)));
    row("shown error, rms, mm", &|g| format!("{:.3}", 1e3 * g.meter.rms()));
    row("shown error, max, mm", &|g| format!("{:.3}", 1e3 * g.meter.max));
    row("largest displacement, mm", &|g| format!("{:.1}", 1e3 * g.meter.largest));
    row("shown error, rms, % of it", &|g| format!("{:.3}", g.meter.percent(g.meter.rms())));
    row("shown error, max, % of it", &|g| format!("{:.3}", g.meter.percent(g.meter.max)));
    row("largest reaction, N", &|g| format!("{:.2}", g.meter.reaction));
    println!(
        "host: time a step, us: median {:.1}, 99th percentile {:.1}; {:.0} bytes a second sent to both",
        percentile(&step, 0.5),
        percentile(&step, 0.99),
        host.bytes_out as f64 / host.seconds.max(1e-9)
    );
}

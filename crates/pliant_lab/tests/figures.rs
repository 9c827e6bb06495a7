//! Draws the paper's figures 7 to 9 again: `cargo test -p pliant_lab --test figures -- --ignored`
//! writes `docs/figures/stream-*.svg`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::fmt::Write as _;
use std::time::Duration;

use pliant_lab::experiment::{Experiment, Metrics};
use pliant_modal::Integrator;
use pliant_stream::emulator::{LinkConfig, Loss};
use pliant_stream::wire::AccelerationCoding;
use pliant_stream::{Newmark, Predict, RecoveryConfig};
use support::bar;

fn run(lost: &[u64], mut recovery: RecoveryConfig) -> Metrics {
    recovery.coding = AccelerationCoding::F64;
    let loss = Loss::Listed(lost.to_vec());
    let link = LinkConfig { delay: Duration::from_millis(10), loss, ..Default::default() };
    let mut e = Experiment::new(bar(6, 0.05), link, recovery);
    e.integrator = Integrator::Newmark;
    e.newmark = Newmark::average(0.025);
    e.resend_after = Duration::from_secs_f64(50.0 * 0.025);
    (e.seconds, e.keep_track) = (18.5, true);
    // The paper's hands have no tremor.
    e.hands.iter_mut().for_each(|h| h.tremor = 0.0);
    e.run().unwrap()
}

const WIDE: f64 = 900.0;
const HIGH: f64 = 170.0;

fn panel(out: &mut String, top: f64, title: &str, curves: &[(&str, &str, &Metrics)]) {
    let first = curves[0].2.track[0].0;
    let scale = curves[0].2.track.iter().map(|t| t.1.abs()).fold(1e-9, f64::max);
    let x = |tick: u64| 60.0 + (tick - first) as f64 / 740.0 * (WIDE - 80.0);
    let y = |u: f64| top + HIGH / 2.0 - (u / scale).clamp(-1.6, 1.6) * HIGH / 3.4;
    writeln!(out, r#"<text x="60" y="{:.0}" font-size="13">{title}</text>"#, top - 6.0).unwrap();
    writeln!(
        out,
        r##"<rect x="60" y="{top:.0}" width="{:.0}" height="{HIGH:.0}" fill="none" stroke="#bbb"/>"##,
        WIDE - 80.0
    )
    .unwrap();
    for (mark, label) in [(1.0, "1"), (0.0, "0"), (-1.0, "-1")] {
        let at = y(mark * scale);
        writeln!(out, r#"<text x="36" y="{:.1}" font-size="10">{label}</text>"#, at + 3.0).unwrap();
        writeln!(out, r##"<line x1="60" x2="{:.0}" y1="{at:.1}" y2="{at:.1}" stroke="#eee"/>"##, WIDE - 20.0)
            .unwrap();
    }
    let mut line = |color: &str, dash: &str, points: &mut dyn Iterator<Item = (u64, f64)>| {
        let mut d = String::new();
        for (tick, u) in points {
            write!(d, "{:.1},{:.1} ", x(tick), y(u)).unwrap();
        }
        writeln!(out, r#"<polyline fill="none" stroke="{color}" stroke-width="1.3" stroke-dasharray="{dash}" points="{d}"/>"#).unwrap();
    };
    for (_, color, f) in curves {
        line(color, "", &mut f.track.iter().map(|t| (t.0, t.2)));
    }
    line("#000", "4 3", &mut curves[0].2.track.iter().map(|t| (t.0, t.1)));
}

#[test]
#[ignore = "writes pictures into docs/figures"]
fn draw() {
    let random: Vec<u64> = {
        let mut r: Vec<u64> = (0..22_u64).map(|k| 135 + (k * 7919 + 31) % 311).collect();
        r.sort_unstable();
        r.dedup();
        r
    };
    assert_eq!(random.len(), 22);
    let cases: [(&str, &str, Vec<u64>); 3] = [
        ("random", "22 lost at random from tick 135", random),
        ("burst", "12 lost in a row from tick 140", (140..152).collect()),
        ("every", "one in 50 lost from tick 135, 11 in all", (0..11).map(|k| 135 + 50 * k).collect()),
    ];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/figures");
    std::fs::create_dir_all(&folder).unwrap();
    for (file, title, lost) in cases {
        let mut svg = String::new();
        let height = 40.0 + 3.0 * (HIGH + 34.0) + 20.0;
        writeln!(svg, r#"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDE}" height="{height}" font-family="sans-serif">"#).unwrap();
        writeln!(svg, r#"<rect width="100%" height="100%" fill="white"/>"#).unwrap();
        let colors = [
            ("zero", "#d95f02", Predict::Zero),
            ("hold", "#1b9e77", Predict::Hold),
            ("linear", "#7570b3", Predict::Linear),
        ];
        let mut x = 60.0;
        for (name, color) in [("without loss (dashed)", "#000"), ("not compensated", "#e7298a")]
            .into_iter()
            .chain(colors.map(|c| (c.0, c.1)))
        {
            writeln!(svg, r#"<text x="{x}" y="18" font-size="12" fill="{color}">{name}</text>"#).unwrap();
            x += 9.0 * name.len() as f64 + 20.0;
        }
        let none = run(&lost, RecoveryConfig::none());
        panel(&mut svg, 50.0, &format!("{title}: not compensated"), &[("none", "#e7298a", &none)]);
        for (k, blend) in [1, 50].into_iter().enumerate() {
            let runs = colors.map(|c| run(&lost, RecoveryConfig::paper_with(c.2, blend)));
            let curves: Vec<_> = colors.iter().zip(&runs).map(|(c, f)| (c.0, c.1, f)).collect();
            for (name, _, f) in &curves {
                assert!(f.end_percent < 1e-7, "{name} blend {blend} ends at {} %", f.end_percent);
            }
            let top = 50.0 + (k as f64 + 1.0) * (HIGH + 34.0);
            let plural = if blend == 1 { "tick" } else { "ticks" };
            panel(&mut svg, top, &format!("compensated 50 ticks later, over {blend} {plural}"), &curves);
        }
        writeln!(svg, "</svg>").unwrap();
        std::fs::write(folder.join(format!("stream-{file}.svg")), svg).unwrap();
    }
}

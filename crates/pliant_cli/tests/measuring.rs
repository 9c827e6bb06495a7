//! The program as a user runs it: streams, times, the cache, the stability matrix and the report.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

mod support;

use std::sync::{Mutex, PoisonError};

use support::{Folder, json, program, refused, succeeds};

/// Makes a bar of linear elements and bakes 12 linear modes of it. Returns the paths of mesh
/// and model.
fn bar(folder: &Folder) -> [String; 2] {
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    succeeds(&["mesh", "bar", "--cells", "8,2,2", "--size", "1,0.2,0.2", "-o", &mesh]);
    succeeds(&[
        "bake",
        &mesh,
        "--material",
        "linear",
        "--element",
        "tet4",
        "--modes",
        "12",
        "--anchor",
        "x<0.01",
        "-o",
        &model,
    ]);
    [mesh, model]
}

#[test]
fn a_stream_is_measured_and_the_same_seed_gives_the_same_figures() {
    let folder = Folder::new("stream");
    let [mesh, model] = bar(&folder);
    let run = |recovery: &str, seed: &str| {
        let text = succeeds(&[
            "stream",
            "--model",
            &model,
            "--network",
            "paper-1",
            "--recovery",
            recovery,
            "--seconds",
            "10",
            "--seed",
            seed,
            "--json",
        ]);
        json(&text)
    };
    let number = |told: &serde_json::Value, key: &str| told[key].as_f64().unwrap();
    let default = run("default", "7");
    assert_eq!(default["hash"], run("default", "7")["hash"]);
    assert_ne!(default["hash"], run("default", "8")["hash"]);
    // 10 s at 40 Hz. On average 9 % of the datagrams are lost, 36 of 400. The bounds are five
    // standard deviations (5.7) either way.
    assert!((390.0..=410.0).contains(&number(&default, "ticks")));
    assert!((8.0..=65.0).contains(&number(&default, "lost")));
    // These are the bounds of the streaming method on this network.
    assert!(number(&default, "rms_percent") < 0.2, "{default}");
    assert!(number(&default, "max_percent") < 3.0, "{default}");
    assert!(number(&default, "kbit_s") < 100.0, "{default}");
    let none = run("none", "7");
    // Without recovery, an acceleration stream never loses an error.
    assert!(number(&none, "rms_percent") > 100.0 * number(&default, "rms_percent"));

    // Nothing measures when a guest's own copy answers a hand, and no number stands for it.
    assert!(default["hand_to_force_ms"].is_null(), "{default}");
    // Without one, the force comes from the host: half the round trip that was measured, 98 ms on
    // this path with an application that looks every 5 ms, half a step of 25 ms, and the delay.
    let there = number(&none, "hand_to_force_ms") - number(&none, "visual_delay_ms");
    println!("the force comes {there} ms after the hand, and {} ms later", number(&none, "visual_delay_ms"));
    assert!((110.0..114.0).contains(&there), "{none}");

    let keys: Vec<&String> = default.as_object().unwrap().keys().collect();
    let promised = "ticks lost recovered rms_percent max_percent end_percent force_rms_percent force_ringing \
        hand_to_force_ms visual_delay_ms recover_ms bytes_per_frame kbit_s cpu_us_per_tick hash";
    let mut promised: Vec<&str> = promised.split_whitespace().collect();
    promised.sort_unstable();
    assert_eq!(keys, promised);

    // Also run a relaxing material, the paper's resending, and equal peers.
    let more = |words: &str| {
        let mut all = vec!["stream", "--model", &model, "--seconds", "18", "--json"];
        all.extend(words.split_whitespace());
        json(&succeeds(&all))
    };
    assert!(number(&more("--relax 0.5:0.4"), "rms_percent") < 0.5);
    let paper = more("--loss random:22@135 --resend-after 50 --recovery paper-hold");
    assert_eq!((number(&paper, "lost"), number(&paper, "ticks") > 300.0), (22.0, true), "{paper}");
    for repair in ["rollback", "compensate"] {
        let told = more(&format!("--topology p2p --recovery {repair} --network wifi"));
        // 18 s at 40 Hz. The peer's own hand is felt in the next step, 25 ms later at most. Its
        // position changes every 5 ms, so that the oldest one that a step answers is 20 ms old.
        assert!((715.0..=721.0).contains(&number(&told, "ticks")), "{told}");
        assert!((15.0..=25.0).contains(&number(&told, "hand_to_force_ms")), "{told}");
        // A peer sees the other by the path and hardly more late, a step at most.
        assert!((15.0..40.0).contains(&number(&told, "visual_delay_ms")), "{told}");
    }

    let table = succeeds(&["stream", "--model", &model, "--loss", "burst:12@140", "--seconds", "10"]);
    assert!(
        table.contains(
            "hand ms is measured between peers, not where an own copy answers (-), and else reckoned"
        ),
        "{table}"
    );
    for name in ["default", "none", "paper", "force-driven"] {
        assert!(table.lines().any(|line| line.starts_with(name)), "{name} in {table}");
    }
    for bad in [
        vec!["--network", "nowhere"],
        vec!["--recovery", "prayer"],
        vec!["--loss", "often"],
        vec!["--rate", "0"],
        vec!["--seconds", "nan"],
        vec!["--relax", "1.0:0.4"],
        vec!["--relax", "much"],
    ] {
        refused(&[&["stream", "--model", &model][..], &bad].concat());
    }
    refused(&["stream", "--model", &mesh]);
}

#[test]
fn a_report_says_what_crosses_the_papers_networks() {
    let folder = Folder::new("networks");
    let part = |name: &str| {
        succeeds(&["report", "--quick", "--only", name, "-o", &folder.file(name)]);
        std::fs::read_to_string(folder.0.join(name).join("report.md")).unwrap()
    };
    // All four networks need far fewer bytes than the paper's 2,000 to 3,000 down and 1,000 to
    // 2,000 up, with a smaller error than the paper's recovery.
    let text = part("table-3");
    let rows: Vec<Vec<&str>> = text
        .lines()
        .filter(|line| line.starts_with("| paper-"))
        .map(|line| line.split('|').map(str::trim).collect())
        .collect();
    assert_eq!(rows.len(), 24, "{text}");
    for row in &rows {
        let number = |column: usize| row[column].parse::<f64>().unwrap();
        assert!((50.0..600.0).contains(&number(6)) && (20.0..300.0).contains(&number(7)), "{row:?}");
    }
    let shown = |row: &[&str]| row[10].split(" / ").next().unwrap().parse::<f64>().unwrap();
    // The default must also beat the better of the paper's two policies.
    assert!(
        100.0 * shown(&rows[4]) < shown(&rows[1]) && shown(&rows[1]) < shown(&rows[0]),
        "9 % lost: {text}"
    );
    // Peers send targets only, which are far smaller than frames.
    let bytes = |row: &[&str]| row[6].parse::<f64>().unwrap();
    for network in rows.chunks(6) {
        assert_eq!([network[4][5], network[5][5]], ["default", "peers, rollback"]);
        assert!(bytes(&network[5]) < 0.7 * bytes(&network[4]), "{network:?}");
    }
    // Coarser frames must be smaller and less accurate, in each of the two lines.
    let text = part("frames");
    let points: Vec<(&str, f64, f64)> = text
        .lines()
        .filter_map(|line| {
            let row: Vec<&str> = line.split('|').map(str::trim).collect();
            Some((*row.get(1)?, row.get(2)?.parse().ok()?, row.get(3)?.parse().ok()?))
        })
        .collect();
    assert_eq!(points.len(), 8, "{text}");
    for pair in points.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        assert!(pair[0].1 < pair[1].1 && pair[0].2 > pair[1].2, "{pair:?}");
    }
}

/// Held by what measures times and by what takes all cores for minutes.
static CORES: Mutex<()> = Mutex::new(());

#[test]
fn a_body_is_timed_against_the_memory() {
    let _cores = CORES.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = Folder::new("bench");
    let [mesh, model] = bar(&folder);
    let told = json(&succeeds(&["bench", "step", &model, "--seconds", "0.05", "--json"]));
    for times in ["step_us", "reconstruct_us"] {
        let at = |part: &str| told[times][part].as_f64().unwrap();
        assert!(0.0 < at("p50") && at("p50") <= at("p99") && at("p99") <= at("p999"), "{told}");
    }
    // Blocks of 16 vertices, (12 modes x 6 rows + 3 of rest) x 16 x 4 bytes each, and 12 bytes
    // written per vertex.
    let vertices = told["surface_vertices"].as_u64().unwrap();
    assert_eq!(
        told["bytes"].as_u64().unwrap(),
        vertices.div_ceil(16) * (12 * 6 + 3) * 16 * 4 + 12 * vertices
    );
    // The speed is that of the median surface: bytes per microsecond are megabytes per second.
    let median = |told: &serde_json::Value, times: &str| told[times]["p50"].as_f64().unwrap();
    let speed = told["bandwidth_gb_s"].as_f64().unwrap();
    let expected = told["bytes"].as_f64().unwrap() / median(&told, "reconstruct_us") * 1e-3;
    assert!((speed / expected - 1.0).abs() < 1e-9, "{speed} GB/s instead of {expected}");
    // No surface is faster than the limit of the memory. That it is the fastest of sums and
    // surfaces and that a frame is a step and a surface is tried on a clock of their own (bench.rs
    // of pliant_lab): a core may change its speed between two timings.
    let limit = told["bandwidth_limit_gb_s"].as_f64().unwrap();
    assert!(speed <= limit, "{told}");
    assert!(median(&told, "reconstruct_us") < median(&told, "frame_us"), "{told}");
    // Four times as many vertices and twice the modes take at least three times as long.
    let (fine, finer) = (folder.file("fine.msh"), folder.file("fine.modal"));
    succeeds(&["mesh", "bar", "--cells", "16,4,4", "--size", "1,0.2,0.2", "-o", &fine]);
    succeeds(&[
        "bake",
        &fine,
        "--material",
        "linear",
        "--element",
        "tet4",
        "--modes",
        "24",
        "--anchor",
        "x<0.01",
        "-o",
        &finer,
    ]);
    let larger = json(&succeeds(&["bench", "step", &finer, "--seconds", "0.05", "--json"]));
    let longer = median(&larger, "reconstruct_us") / median(&told, "reconstruct_us");
    println!("a surface of 24 modes and four times the vertices takes {longer:.1} times as long");
    assert!(longer > 3.0, "{larger}");
    let half = json(&succeeds(&["bench", "step", &model, "--seconds", "0.05", "--half", "--json"]));
    assert_eq!(
        half["bytes"].as_u64().unwrap(),
        vertices.div_ceil(16) * (12 * 6 * 2 + 3 * 4) * 16 + 12 * vertices
    );
    refused(&["bench", "step", &mesh]);
    refused(&["bench", "step", &model, "--seconds", "-1"]);
}

#[test]
fn a_pull_feels_a_beam_as_timoshenko_says() {
    let folder = Folder::new("pull");
    let (mesh, model, pulled) = (folder.file("bar.msh"), folder.file("bar.modal"), folder.file("out.ply"));
    succeeds(&["mesh", "bar", "--cells", "20,2,2", "--size", "1,0.1,0.1", "-o", &mesh]);
    let bake = ["bake", &mesh, "--modes", "20", "--young", "2e6", "--poisson", "0", "--anchor", "x<0.001"];
    succeeds(&[&bake[..], &["--material", "linear", "--rayleigh", "0,0", "-o", &model]].concat());
    let at = ["pull", &model, "--at", "1,0.05,0.05", "--radius", "0.08"];
    let by = |by: &str| json(&succeeds(&[&at[..], &["--by", by, "--json"]].concat()));
    // w = P L^3 / (3 E I) + P L / (k G A) with k = 10 (1 + nu) / (12 + 11 nu).
    let (young, poisson, thick, way) = (2e6, 0.0, 0.1f64, 0.001);
    let bending = 1.0 / (3.0 * young * thick.powi(4) / 12.0);
    let shear_factor = 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson);
    let shear = 1.0 / (shear_factor * young / (2.0 * (1.0 + poisson)) * thick * thick);
    let aside = by("0,0.001,0");
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    let force = -number(&aside["reaction"][1]);
    let expected = way / (bending + shear);
    assert!((force / expected - 1.0).abs() < 0.02, "{force} N, Timoshenko {expected} N");
    // Half the force along the way, but for the little that the bar moves sideways.
    assert!((number(&aside["energy"]) / (0.5 * force * way) - 1.0).abs() < 1e-3, "{aside}");
    for (axis, moved) in aside["moved"].as_array().unwrap().iter().enumerate() {
        let wanted = if axis == 1 { way } else { 0.0 };
        assert!((number(moved) - wanted).abs() < 1e-3 * way, "{aside}");
    }
    let (vertices, weights) = (aside["vertices"].as_array().unwrap(), aside["weights"].as_array().unwrap());
    assert_eq!(vertices.len(), weights.len());
    assert!((weights.iter().map(number).sum::<f64>() - 1.0).abs() < 1e-9);
    for axis in 0..3 {
        let mean: f64 = vertices.iter().zip(weights).map(|(v, w)| number(&v[axis]) * number(w)).sum();
        assert!((mean - number(&aside["patch"][axis])).abs() < 1e-6);
    }
    assert_eq!((&aside["elasticity"], &aside["at_rest"]), (&"linear".into(), &true.into()));
    assert!(number(&aside["step_us"]["p50"]) <= number(&aside["step_us"]["p999"]));

    let told = succeeds(&[&at[..], &["--by", "0,0.2,0", "--surface", &pulled]].concat());
    assert!(told.contains("reaction") && told.contains("elastic energy"), "{told}");
    let surface = pliant_mesh::io::read_surface(&pulled).unwrap();
    let end = surface.positions.iter().map(|p| p[1]).fold(0.0, f64::max);
    assert!((end - 0.3).abs() < 0.02, "{end}");

    assert!(refused(&[&at[..], &["--by", "0,nan,0"]].concat()).contains("finite"));
    let none = ["pull", &model, "--at", "nan,0,0", "--radius", "0.08", "--by", "0,0,0"];
    assert!(refused(&none).contains("finite"));
    for far in ["1000,50,50", "1e200,0,0"] {
        let millimeters = ["pull", &model, "--at", far, "--radius", "0.08", "--by", "0,0.1,0"];
        assert!(refused(&millimeters).contains("away from the surface"));
    }
    let free = folder.file("free.modal");
    succeeds(&["bake", &mesh, "--modes", "6", "-o", &free]);
    let follows = refused(&["pull", &free, "--at", "1,0,0", "--radius", "0.1", "--by", "0,0.1,0"]);
    assert!(follows.contains("free"), "{follows}");
}

#[test]
fn an_unchanged_bake_comes_from_the_cache() {
    let folder = Folder::new("cache");
    let mesh = folder.file("bar.msh");
    succeeds(&["mesh", "bar", "--cells", "4,2,2", "--size", "0.4,0.2,0.2", "-o", &mesh]);
    let cache = folder.file("cache");
    let bake = |output: &str, more: &[&str]| {
        let mut arguments =
            vec!["bake", &mesh, "--modes", "6", "--anchor", "x<0.001", "-o", output, "--json"];
        arguments.extend(more);
        json(&succeeds(&arguments))
    };
    let [a, b, c] = ["a.modal", "b.modal", "c.modal"].map(|name| folder.file(name));
    let first = bake(&a, &["--cache", &cache]);
    assert_eq!(first["cached"], false);
    let second = bake(&b, &["--cache", &cache]);
    assert_eq!(second["cached"], true);
    assert_eq!(second["hash"], first["hash"]);
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
    assert_eq!(bake(&c, &["--cache", &cache, "--young", "2e5"])["cached"], false);
    assert_eq!(bake(&c, &["--no-cache"])["cached"], false);
    let told = succeeds(&["bake", &mesh, "--modes", "6", "--anchor", "x<0.001", "-o", &b, "--cache", &cache]);
    assert!(told.contains("read from the cache"), "{told}");
    assert!(refused(&["bake", &mesh, "-o", &b, "--cache", &cache, "--no-cache"]).contains("--no-cache"));

    // Use the user's own cache. An unusable cache gives a message on stderr and no failure.
    let with_home = |home: &str| {
        let output = program()
            .env("XDG_CACHE_HOME", home)
            .args(["bake", &mesh, "--modes", "6", "-o", &c, "--json"])
            .output()
            .unwrap();
        assert!(output.status.success());
        let cached = json(std::str::from_utf8(&output.stdout).unwrap())["cached"].as_bool().unwrap();
        (cached, String::from_utf8(output.stderr).unwrap())
    };
    if cfg!(all(unix, not(target_os = "macos"))) {
        let home = folder.file("home");
        assert_eq!(with_home(&home), (false, String::new()));
        assert_eq!(with_home(&home), (true, String::new()));
        let (cached, word) = with_home(&mesh);
        assert!(!cached && word.contains("not kept"), "{word}");
    }
}

/// A row of the page of the stability matrix.
#[derive(Debug)]
struct Row {
    name: String,
    /// The third cell: a margin, or what a known limit measures.
    third: Option<f64>,
    /// What the tightest bound is about, and the number that it measures.
    bound: Option<(String, f64)>,
    /// The fifth cell of a known limit's number: what it may be.
    range: Option<[f64; 2]>,
}

impl Row {
    fn of(line: &str) -> Self {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
        let number = |text: &str| text.trim_start_matches("> ").parse().ok();
        let bound = |cell: &str| {
            let (what, measured) = cell.split_once(" <= ")?.0.rsplit_once(' ')?;
            Some((what.to_owned(), number(measured)?))
        };
        Self {
            name: cells[0].to_owned(),
            third: cells.get(2).copied().and_then(number),
            bound: cells.get(3).copied().and_then(bound),
            range: cells.get(4).and_then(|cell| {
                let (low, high) = cell.split_once(" to ")?;
                Some([low.parse().ok()?, high.parse().ok()?])
            }),
        }
    }

    /// Whether this row tells what an older one tells.
    fn is_still(&self, old: &Self) -> bool {
        // Smaller numbers are rounding, or where a solver stops, and differ from processor to
        // processor.
        const ROUNDING: f64 = 1e-6;
        if let (Some(now), Some([low, high])) = (self.third, old.range) {
            return self.name == old.name && self.range == old.range && (low..=high).contains(&now);
        }
        let alike = match (&self.bound, &old.bound) {
            (Some(now), Some(then)) if now.0 == then.0 && then.1 < ROUNDING => {
                now.1 <= 100.0 * then.1 + 1e-13
            }
            // Of two that are rounding, either may be the tightest.
            (Some(now), Some(then)) if now.1.max(then.1) < ROUNDING => self.third >= Some(1.0),
            _ => match (self.third, old.third) {
                (Some(now), Some(then)) => now == then || (0.8..=1.25).contains(&(now / then)),
                (now, then) => now == then,
            },
        };
        self.name == old.name && alike
    }
}

#[test]
fn the_stability_matrix_keeps_its_bounds_and_is_the_committed_page() {
    let _cores = CORES.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = Folder::new("stability");
    let page = folder.file("stability.md");
    let told = json(&succeeds(&["stability", "--json", "-o", &page]));
    let cases = told["cases"].as_array().unwrap();
    let (mut with_the_papers_scheme, mut limits) = (0, 0);
    for case in cases {
        // `known_limit` is set only if the result is the one that the limit expects. A limit that
        // does not apply any more is reported, too.
        let limit = case["known_limit"].is_string();
        assert!((case["passed"] == true) != limit && case["limit_gone"] == false, "{case}");
        assert_eq!(case["margin"].as_f64().unwrap() >= 1.0, !limit, "{case}");
        assert!(case["bound"].as_str().unwrap().contains("<=") || limit, "{case}");
        limits += usize::from(limit);
        with_the_papers_scheme += usize::from(case["plain"].is_string());
    }
    assert!(with_the_papers_scheme >= 40 && limits == 48, "{with_the_papers_scheme}, {limits}");
    let committed = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/report/stability.md");
    let rows = |path: &str| -> Vec<Row> {
        let text = std::fs::read_to_string(path).unwrap();
        assert!(text.contains("*Made on 20") && text.contains("The networks have the seed 1"), "{path}");
        text.lines().filter(|line| line.starts_with('|')).map(Row::of).collect()
    };
    let (now, then) = (rows(&page), rows(committed));
    assert_eq!(now.len(), then.len());
    for (now, then) in now.iter().zip(&then) {
        assert!(now.is_still(then), "{now:?}, told {then:?}");
    }
    let row = |bound: &str, margin: &str| Row::of(&format!("| a | - | {margin} | {bound} |"));
    // These are alike: a digit, rounding, and a number that a processor has as 0.
    let told = row("x 1.000e-1 <= 2.000e-1", "2.000");
    assert!(row("x 1.100e-1 <= 2.000e-1", "1.818").is_still(&told));
    assert!(row("x 9.0e-15 <= 1.0e-9", "111111").is_still(&row("x 1.0e-16 <= 1.0e-9", "> 1e6")));
    assert!(row("y 0.000e0 <= 1.0e-9", "> 1e6").is_still(&row("x 1.0e-16 <= 1.0e-9", "> 1e6")));
    assert!(!row("y 2.0e-9 <= 1.0e-9", "0.5").is_still(&row("x 1.0e-16 <= 1.0e-9", "> 1e6")));
    // These are not, although each keeps its bound.
    for (now, then) in [
        (row("x 1.300e-1 <= 2.000e-1", "1.538"), told),
        (row("x 1.0e-4 <= 1.0e-1", "1000"), row("x 1.0e-5 <= 1.0e-1", "10000")),
        (row("x 1.0e-4 <= 1.0e-1", "1000"), row("x 0.000e0 <= 1.0e-1", "> 1e6")),
        (row("x 1.0e-10 <= 1.0e-9", "10"), row("x 1.0e-15 <= 1.0e-9", "> 1e6")),
    ] {
        assert!(!now.is_still(&then), "{now:?}, told {then:?}");
    }
    let nowhere = folder.file("nowhere/stability.md");
    assert!(refused(&["stability", "--only", "inputs", "-o", &nowhere]).contains("the folder"));
    // These are exactly the meshes that the bake rejects.
    let told = json(&succeeds(&["stability", "--only", "element shape", "--json"]));
    let limits: Vec<&str> = told["cases"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|case| case["known_limit"].is_string() && case["permitted"] == serde_json::json!([]))
        .map(|case| case["name"].as_str().unwrap())
        .collect();
    let [needles, plates, slivers] =
        ["needles, edges 40 : 1", "plates, edges 50 : 1", "slivers, a millionth"];
    assert_eq!(limits.len(), 3, "{limits:?}");
    for (name, want) in limits.iter().zip([needles, plates, slivers]) {
        assert!(name.starts_with(want), "{limits:?}");
    }
    let message = refused(&["stability", "--only", "no such case"]);
    assert!(message.contains("--only"), "{message}");
}

/// The mean number of runnable programs over the last minute, where the system tells it.
fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}

#[test]
fn a_report_writes_its_words_numbers_and_pictures() {
    let folder = Folder::new("report");
    let told =
        json(&succeeds(&["report", "--quick", "--only", "steps", "-o", &folder.file("out"), "--json"]));
    assert_eq!(told["parts"][0]["name"], "steps");
    let read = |name: &str| std::fs::read(folder.0.join("out").join(name)).unwrap();
    for file in told["parts"][0]["files"].as_array().unwrap() {
        assert!(!read(file.as_str().unwrap()).is_empty(), "{file}");
    }
    assert!(read("c-steps-free.png").starts_with(b"\x89PNG"));
    let text = String::from_utf8(read("report.md")).unwrap();
    // Each figure that is told is shown in the text.
    for file in told["parts"][0]["files"].as_array().unwrap() {
        let name = file.as_str().unwrap();
        assert!(!name.ends_with(".svg") || text.contains(&format!("]({name})")), "{name}");
    }
    // The exact integrator needs no small steps. At 60 Hz the error of a struck bar is rounding
    // only, and Newmark's error is more than a percent.
    let csv = String::from_utf8(read("c-steps-free.csv")).unwrap();
    let error = |line: &str| {
        let row = csv.lines().find(|row| row.starts_with(&format!("\"{line}"))).unwrap();
        row.split(',').nth(2).unwrap().parse::<f64>().unwrap()
    };
    assert!(error("exact") < 1e-12 && error("Newmark") > 0.01, "{csv}");
    // If the system reports its load, the report must have the load at its end.
    if let Some(load) = load() {
        let (_, told) = text.split_once("at the start and ").unwrap();
        let told: f64 = told.split(' ').next().unwrap().parse().unwrap();
        assert!((told - load).abs() < 0.3 + 0.1 * load, "{told} told, {load} measured");
    }
    // The 99th percentile of a time is no less than its median.
    let timed: Vec<Vec<f64>> = (text.lines())
        .filter(|line| line.starts_with("| exact (default) |"))
        .map(|line| line.split('|').filter_map(|cell| cell.trim().parse().ok()).collect())
        .collect();
    assert!(timed.len() >= 9 && timed.iter().all(|row| row.len() == 3 && row[0] <= row[1]), "{timed:?}");
    let message = refused(&["report", "--only", "nothing", "-o", &folder.file("out")]);
    assert!(message.contains("--only"), "{message}");
}

//! What the pages say of other programs, of what a scene leaves out, and of the ball that bounces.

use crate::page::{DECISIONS, MEASUREMENTS, QUESTIONS, cells, number, range, read, row, says, says_range};

#[test]
fn other_programs_take_as_long_as_was_measured() {
    let table = |name: &str, column: &str| -> Vec<(String, f64)> {
        let text = read(&format!("docs/report/{name}.csv"));
        let mut rows = text.lines().map(cells);
        let head = rows.next().unwrap();
        let at = head.iter().position(|name| name == column).unwrap();
        // A row that was not measured has no number.
        let of = |row: Vec<String>| {
            assert_eq!(row.len(), head.len(), "{row:?}");
            Some((format!("{}, {}", row[0], row[1]), row[at].parse().ok()?))
        };
        rows.filter_map(of).collect()
    };
    let of = |rows: &[(String, f64)], wanted: &dyn Fn(&str) -> bool| {
        range(&rows.iter().filter(|row| wanted(&row.0)).map(|row| row.1).collect::<Vec<_>>())
    };
    let times = table("peers-times", "ratio_median");
    for name in ["SciPy", "PyBullet", "MuJoCo", "Exudyn", "Rapier"] {
        assert!(times.iter().any(|row| row.0.starts_with(name)), "{name} was not measured");
    }
    let steps = of(&times, &|name| !name.starts_with("SciPy"));
    says_range(DECISIONS, "%) a step of theirs takes", steps);
    for (name, ratio) in times.iter().filter(|row| row.0.starts_with("SciPy")) {
        let tetrahedra = number(name.split_once(" of ").unwrap().1).0 as u32;
        let told = format!("for {},{:03} tetrahedra", tetrahedra / 1000, tetrahedra % 1000);
        says(DECISIONS, &told, *ratio);
    }

    let errors = table("peers-error", "error_percent");
    let reduced = of(&errors, &|name| {
        name.starts_with("Pliant, reduced, ") && name.ends_with("of 960 tetrahedra") && !name.contains("four")
    });
    let four = of(&errors, &|name| name.starts_with("Pliant, reduced, four nodes"));
    let linear = of(&errors, &|name| name.starts_with("Pliant, linear with warp, four nodes"));
    let others = of(&errors, &|name| !name.starts_with("Pliant"));
    // The times of the others stand beside the error of the body by whose time they are divided.
    let beside = of(&table("peers-error", "ratio_median"), &|name| !name.starts_with("Pliant"));
    says_range(DECISIONS, "that hangs still takes PyBullet, MuJoCo, Exudyn or Rapier", beside);
    says_range(DECISIONS, "which with 10 to 40 is off by", reduced);
    says_range(DECISIONS, "% of the length; they are off by", others);
    says_range(DECISIONS, "On their four-node grids ours is off by", four);
    says_range(DECISIONS, "Beside 20 linear modes on four nodes (off by", linear);
    says(QUESTIONS, "SciPy finds 20 modes of a small bar, and the six rigid ones, in", times[0].1);
}

#[test]
fn what_a_scene_leaves_out_is_what_was_measured() {
    let csv = read("docs/report/leave-out.csv");
    let head: Vec<&str> = csv.lines().next().unwrap().split(',').collect();
    let of = |scene: &str, column: &str| -> f64 {
        let row = csv.lines().find(|row| row.starts_with(&format!("{scene},"))).unwrap();
        // The second cell may be quoted and have commas. The numbers are counted from the end.
        let cells: Vec<&str> = row.split(',').collect();
        let from_end = head.len() - head.iter().position(|name| *name == column).unwrap();
        cells[cells.len() - from_end].parse().unwrap()
    };
    for (before, scene, column) in [
        ("a body with a window", "solo", "crates"),
        ("a body with a window 327, a host without a picture", "host", "crates"),
        ("a host without a picture 216, a guest", "guest", "crates"),
        ("a guest 361, a body with a haptic device", "haptics", "crates"),
        ("a haptic device 347, everything", "everything", "crates"),
        ("`PliantPlugins` adds", "solo", "systems"),
        ("`PliantPlugins` adds 36 to the engine's", "solo", "engine_systems"),
        ("drawn by the processor take", "many", "work_frame_ms"),
        ("a host without a picture is", "host", "program_mb"),
        ("35 MB, and takes", "host", "rest_frame_ms"),
        ("0.52 ms for a frame at rest and", "host", "work_frame_ms"),
        ("A program with a window is", "solo", "program_mb"),
        ("95 MB, and one with everything", "everything", "program_mb"),
    ] {
        says(MEASUREMENTS, before, of(scene, column));
    }
    let more = |scene| of(scene, "work_frame_ms") - of(scene, "rest_frame_ms");
    says(MEASUREMENTS, "In motion, one body adds", more("solo"));
    says(MEASUREMENTS, "0.13 ms, a guest's body", more("guest"));
    says(MEASUREMENTS, "0.44 ms, everything together", more("everything"));
    says(DECISIONS, "A body with a window compiles", of("solo", "crates"));
    says(DECISIONS, "327 crates, a host without a picture", of("host", "crates"));
    says(DECISIONS, "216, and everything together", of("everything", "crates"));
}

#[test]
fn a_ball_that_bounces_is_told_as_it_was_measured() {
    let csv = read("docs/report/bounce.csv");
    let mut lines = csv.lines();
    let head: Vec<&str> = lines.next().unwrap().split(',').collect();
    let cell = |row: &[String], name: &str| -> f64 {
        row[head.iter().position(|column| *column == name).unwrap()].parse().unwrap()
    };
    // What ended otherwise says why in the last cell.
    let rows: Vec<Vec<String>> =
        lines.map(cells).filter(|row| row.last().is_some_and(String::is_empty)).collect();
    let of = |ours: bool, least: f64, name: &str| -> Vec<f64> {
        let some = rows.iter().filter(|row| row[0].starts_with("Pliant") == ours);
        some.filter(|row| cell(row, "steps_a_second") >= least).map(|row| cell(row, name)).collect()
    };
    let page = read("docs/report/bounce.md");
    let exact: Vec<f64> = row("docs/report/bounce.md", "| exact, by Hertz's law |")
        .iter()
        .filter_map(|cell| cell.parse().ok())
        .collect();
    let [time, force, _] = exact[..] else { panic!("{exact:?} in {page}") };
    let shares = |ours| of(ours, 1000.0, "force_n").iter().map(|f| 100.0 * f / force).collect::<Vec<_>>();
    says(DECISIONS, "touches the floor for 10.6 to 12 ms, where Hertz has", time);
    says_range(
        DECISIONS,
        "At 1,000 steps a second and more it touches the floor for",
        range(&of(true, 1e3, "contact_ms")),
    );
    says_range(DECISIONS, "ms, where Hertz has 11.51, with", range(&shares(true)));
    let its_times = range(&of(false, 1e3, "contact_ms"));
    says_range(DECISIONS, "Rapier, MuJoCo and PyBullet are within", its_times);
    says_range(DECISIONS, "are within 10.5 to 15 ms and", range(&shares(false)));
    // Each of theirs over each of ours, at as many steps and of as many tetrahedra.
    let ratios = |steps: f64| -> Vec<(String, f64)> {
        let at: Vec<&Vec<String>> = rows.iter().filter(|row| cell(row, "steps_a_second") == steps).collect();
        let ms = |row: &[String]| cell(row, "ms_a_second");
        let (ours, theirs): (Vec<_>, Vec<_>) = at.into_iter().partition(|row| row[0].starts_with("Pliant"));
        let both = theirs.iter().flat_map(|its| ours.iter().map(move |own| (its, own)));
        let alike = both.filter(|(its, own)| its[1] == own[1]);
        alike.map(|(its, own)| (its[0].clone(), ms(its) / ms(own))).collect()
    };
    let worth = |all: &[(String, f64)]| range(&all.iter().map(|ratio| ratio.1).collect::<Vec<_>>());
    let (thousand, most) = (ratios(1e3), ratios(16e3));
    assert!(thousand.iter().all(|ratio| !ratio.0.starts_with("PyBullet")), "it has no run there");
    assert!(most.iter().all(|ratio| ratio.0.starts_with("PyBullet")), "it alone has runs there");
    let [least_times, most_times] = worth(&thousand);
    says(DECISIONS, "At 1,000 steps Rapier and MuJoCo take", least_times);
    // Told in hundreds.
    says(DECISIONS, "Rapier and MuJoCo take 17 to", (most_times / 100.0).round() * 100.0);
    says_range(DECISIONS, "runs at 16,000 only and takes", worth(&most));
    let linear = |steps: f64| {
        let row = rows.iter().find(|row| row[0] == "Pliant, linear" && cell(row, "steps_a_second") == steps);
        cell(row.unwrap(), "height_percent")
    };
    for (before, steps) in [
        ("comes back to", 240.0),
        ("of its height at 240 steps a second, to", 1000.0),
        ("at 1,000 and to", 16_000.0),
    ] {
        says("docs/contact.md", before, linear(steps));
    }
}

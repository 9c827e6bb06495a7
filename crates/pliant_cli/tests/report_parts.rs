//! Runs each part of the report in its short form and checks its files and that the numbers match
//! the text.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

mod support;

use support::{Folder, json, succeeds};

/// One part of the report that has been run.
struct Part {
    folder: Folder,
    text: String,
}

impl Part {
    fn of(name: &str) -> Self {
        let folder = Folder::new(&format!("part-{name}"));
        let out = folder.file("out");
        // Surfaces of others are not available, so the project's own body replaces them.
        let none = folder.file("none");
        let told = json(&succeeds(&[
            "report",
            "--quick",
            "--only",
            name,
            "--models",
            &none,
            "--own",
            "../../assets/pip.ron",
            "-o",
            &out,
            "--json",
        ]));
        assert_eq!(told["parts"][0]["name"], name);
        for file in told["parts"][0]["files"].as_array().unwrap() {
            let written = std::fs::read(folder.0.join("out").join(file.as_str().unwrap())).unwrap();
            assert!(written.len() > 40, "{file}");
        }
        let text = std::fs::read_to_string(folder.0.join("out/report.md")).unwrap();
        Self { folder, text }
    }

    /// Name of the line, x and y of each point of a figure.
    fn points(&self, figure: &str) -> Vec<(String, f64, f64)> {
        let csv = std::fs::read_to_string(self.folder.0.join(format!("out/{figure}.csv"))).unwrap();
        csv.lines()
            .skip(1)
            .map(|line| {
                let (name, rest) = line[1..].split_once("\",").unwrap();
                let mut numbers = rest.split(',').map(|number| number.parse::<f64>());
                (name.to_owned(), numbers.next().unwrap().unwrap(), numbers.next().unwrap().unwrap())
            })
            .collect()
    }

    fn line(&self, figure: &str, name: &str) -> Vec<(f64, f64)> {
        let points = self.points(figure);
        let line: Vec<_> = points.iter().filter(|p| p.0 == name).map(|p| (p.1, p.2)).collect();
        assert!(!line.is_empty(), "{name} in {points:?}");
        line
    }
}

fn last(line: &[(f64, f64)]) -> f64 {
    line.last().unwrap().1
}

#[test]
fn elements_come_nearer_to_a_far_finer_mesh() {
    let part = Part::of("elements");
    for figure in ["a-elements", "a-bar-frequencies", "a-bar-pull"] {
        for name in ["tet4", "tet10"] {
            let line = part.line(figure, name);
            assert!(line.windows(2).all(|pair| pair[1].1 < pair[0].1), "{figure}, {name}: {line:?}");
        }
    }
    // Linear elements on this bar are tens of percent too stiff. Quadratic elements on the same
    // mesh are not.
    let (four, ten) = (part.line("a-bar-pull", "tet4"), part.line("a-bar-pull", "tet10"));
    assert!(four[0].1 > 0.1 && ten[0].1 < 0.05, "{four:?}, {ten:?}");
}

#[test]
fn modes_left_out_are_given_to_the_hand_by_their_flexibility() {
    let part = Part::of("modes");
    let [with, without] =
        ["with residual flexibility (default)", "without"].map(|name| part.line("b-modes", name));
    for (with, without) in with.iter().zip(&without) {
        assert!(with.1 < 0.5 * without.1, "{with:?}, {without:?}");
    }
    // Both lines must be timed separately.
    assert!(with.iter().zip(&without).any(|(with, without)| with.0 != without.0));
    let shape = part.line("b-modes-shape", "with residual flexibility (default)");
    assert!(last(&shape) < 0.01 && shape[0].1 > 0.02, "{shape:?}");
    let [few, many] = ["2 modes", "32 modes"].map(|name| part.line("b-modes-time", name));
    assert_eq!((few.len(), many.len()), (120, 120));
    assert!(last(&many) < 0.2 * last(&few), "{:?}, {:?}", few.last(), many.last());
    assert!(part.text.contains("no error of its own"), "{}", part.text);
}

#[test]
fn under_a_hand_shorter_steps_are_better() {
    let part = Part::of("steps");
    // From 60 to 960 steps a second, second order means 256 times smaller errors. On a bent body no
    // step reaches it: the exact one has a small first-order part, which comes from the rows of the
    // hand, those of the step's end.
    let gain = |name: &str| {
        let line = part.line("c-steps-held", name);
        line[0].1 / last(&line)
    };
    let (exact, alpha) = (gain("exact (default)"), gain("generalized-alpha 0.5"));
    assert!(exact > 30.0 && alpha > 60.0, "{exact}, {alpha}");
    let exact = part.line("c-steps-held", "exact (default)");
    let [at_60, at_120, at_240] = [0, 1, 2].map(|k| exact[k].1);
    println!("the force is off by {at_60:.2e}, {at_120:.2e} and {at_240:.2e} at 60, 120 and 240 Hz");
    assert!(at_60 < 6e-3 && at_120 < 1.5e-3 && at_240 < 6e-4, "{exact:?}");
    assert!(gain("Newmark (the paper's)") > 60.0);
    // The error of a usable reference is at most a tenth of the measured errors.
    let csv = std::fs::read_to_string(part.folder.0.join("out/c-steps-held.csv")).unwrap();
    let own: f64 = csv.lines().nth(1).unwrap().split(',').nth(3).unwrap().parse().unwrap();
    let least = part.points("c-steps-held").iter().map(|p| p.2).fold(f64::INFINITY, f64::min);
    assert!(own < 0.1 * least, "{own:e} and {least:e}");
    let drift = part.line("c-steps-time", "Newmark (the paper's)");
    assert!(drift.len() == 60 && last(&part.line("c-steps-time", "exact (default)")) < 1e-6, "{drift:?}");
}

#[test]
fn the_warp_is_told_where_it_loses() {
    let part = Part::of("warp");
    let [with, without] =
        ["warped (default)", "linear, without warp"].map(|name| part.line("d-warp-bend", name));
    let worse = with.iter().zip(&without).filter(|(with, without)| with.1 > without.1).count();
    assert_eq!(part.text.contains("*worse* of the two"), worse > 0 || part.text.contains("along the pull"));
    assert!(last(&with) < last(&without), "far out the warp is the better: {with:?}, {without:?}");
    let [with, without] =
        ["warped (default)", "linear, without warp"].map(|name| part.line("d-warp-twist", name));
    assert!(last(&with) < 0.5 * last(&without), "{with:?}, {without:?}");
    // Each figure has its own residual of the solver.
    let own = |figure: &str| -> f64 {
        let csv = std::fs::read_to_string(part.folder.0.join(format!("out/{figure}.csv"))).unwrap();
        csv.lines().nth(1).unwrap().split(',').nth(3).unwrap().parse().unwrap()
    };
    assert!(
        own("d-warp-bend") < 1e-8 && own("d-warp-twist") < 1e-8 && own("d-warp-bend") != own("d-warp-twist")
    );
}

#[test]
fn half_precision_is_off_by_its_rounding() {
    let part = Part::of("precision");
    let half = part.line("e-precision", "f16 basis")[0].1;
    // The bound is about 2^-11 of a motion by a fifth of the length.
    assert!((1e-6..2.0f64.powi(-11) * 0.3).contains(&half), "{half:e}");
}

#[test]
fn ways_of_repair_are_ordered_by_loss_and_timed() {
    let part = Part::of("network");
    for name in ["default", "paper", "paper-zero", "force-driven", "peers, rollback", "peers, compensate"] {
        let line = part.line("f-network", name);
        assert!(line.len() == 4 && line[0].1 > last(&line), "{name}: more loss, more error: {line:?}");
        assert!(part.line("f-network-time", name).iter().all(|p| (0.1..1e4).contains(&p.0)), "{name}");
    }
    let worst = |name: &str| part.line("f-network", name)[0].1;
    assert!(100.0 * worst("default") < worst("paper-zero") && worst("paper-zero") < worst("paper"));
    assert!(part.text.contains("| ticks missing |"), "{}", part.text);
}

#[test]
fn the_front_is_what_was_measured_and_so_is_the_advice() {
    let part = Part::of("front");
    for figure in ["g-front-eye", "g-front-hand", "g-front-network"] {
        let points = part.points(figure);
        let front: Vec<_> = points.iter().filter(|p| p.0.starts_with("the front")).collect();
        assert!(!front.is_empty(), "{figure}");
        // The file has four digits, so neighbors may look alike.
        for pair in front.windows(2) {
            assert!(pair[0].1 <= pair[1].1 && pair[0].2 >= pair[1].2, "{figure}: {pair:?}");
        }
        // No point lies below and to the left of the front.
        for p in points.iter().filter(|p| !p.0.starts_with("the front")) {
            assert!(front.iter().any(|f| f.1 <= p.1 * 1.001 && f.2 <= p.2 * 1.001), "{figure}: {p:?}");
        }
    }
    assert!(part.text.contains("Which setting for which need, by these points: *a body that is looked at*"));
    // More modes on the better element reduce the visual error, down to some percent.
    let eye = part.points("g-front-eye");
    let best =
        |name: &str| eye.iter().filter(|p| p.0.starts_with(name)).map(|p| p.2).fold(f64::INFINITY, f64::min);
    assert!(
        best("ten-node") < 0.1 && best("ten-node") < best("four-node"),
        "{} {}",
        best("ten-node"),
        best("four-node")
    );
}

#[test]
fn courses_say_how_late_each_line_was_answered() {
    let part = Part::of("courses");
    for figure in ["paper-7", "paper-8", "paper-9"] {
        let peak = |name: &str| part.line(figure, name).iter().fold(0.0f64, |most, p| most.max(p.1.abs()));
        let [late, once] =
            ["the paper's, taken out over 50 ticks", "the paper's over 50 ticks, answered at once"].map(peak);
        // The error stays until an answer arrives, and is gone at the end.
        assert!(late > 0.0 && late >= once, "{figure}: {late} and {once}");
        assert!(last(&part.line(figure, "the paper's, taken out over 50 ticks")).abs() < 1e-6);
        assert!(peak("default") < late && peak("default, answered at once") < late, "{figure}");
    }
    assert!(part.text.contains("anywhere on the surface") && part.text.contains("answered at once"));
}

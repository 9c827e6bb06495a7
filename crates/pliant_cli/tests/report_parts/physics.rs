//! Parts on elements, modes, steps and warp.

use crate::part::{Part, last, number_after};

#[test]
fn elements_come_nearer_to_a_far_finer_mesh() {
    let part = Part::of("elements");
    for figure in ["a-elements", "a-bar-frequencies", "a-bar-pull"] {
        for name in ["tet4", "tet10"] {
            let line = part.line(figure, name);
            assert!(line.windows(2).all(|pair| pair[1].1 < pair[0].1), "{figure}, {name}: {line:?}");
        }
        part.table_is_the_csv(figure);
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
    part.table_is_the_csv("b-modes");
    part.table_is_the_csv("b-modes-shape");
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
    let told = number_after(part.section("c-steps-held"), "The error of the reference is about ");
    assert!((told / own - 1.0).abs() < 0.06, "{told:e} in the text, {own:e} in the file");
    part.table_is_the_csv("c-steps-held");
    let drift = part.line("c-steps-time", "Newmark (the paper's)");
    assert!(drift.len() == 60 && last(&part.line("c-steps-time", "exact (default)")) < 1e-6, "{drift:?}");
}

#[test]
fn the_warp_is_told_where_it_loses() {
    let part = Part::of("warp");
    let [with, without] =
        ["warped (default)", "linear, without warp"].map(|name| part.line("d-warp-bend", name));
    // Where the text says that the warp loses, and by what, is where the file has it.
    let worse: Vec<_> = with.iter().zip(&without).filter(|(with, without)| with.1 > without.1).collect();
    let told = part.section("d-warp-bend").split_once("is the *worse* of the two at ");
    let told: Vec<[f64; 3]> = told.map_or(Vec::new(), |(_, list)| {
        let list = list.split(" of the length").next().unwrap().trim_end_matches(')');
        let numbers = |entry: &str| -> [f64; 3] {
            let numbers = entry.split([' ', '(', ',']).filter_map(|word| word.parse().ok());
            numbers.collect::<Vec<f64>>().try_into().unwrap()
        };
        list.split("), ").map(numbers).collect()
    });
    assert_eq!(told.len(), worse.len(), "{told:?} and {worse:?}");
    for ([at, with, without], (real_with, real_without)) in told.iter().zip(worse) {
        assert!((at - real_with.0).abs() < 6e-4, "{told:?}");
        assert!((with / real_with.1 - 1.0).abs() < 0.06 && (without / real_without.1 - 1.0).abs() < 0.06);
    }
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

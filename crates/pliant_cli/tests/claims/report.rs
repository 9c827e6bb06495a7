//! What the pages say of the report's parts on elements, modes, steps, warp, elasticity and
//! surfaces.

use crate::page::{
    DECISIONS, LIMITS, MEASUREMENTS, PERFORMANCE, REPORT, line, number, range, row, says, says_range,
};

#[test]
fn the_elements_and_modes_are_those_of_the_report() {
    let (four, ten) = (line("a-elements", "tet4"), line("a-elements", "tet10"));
    let within = ten.iter().find(|p| p.1 < 0.01).unwrap();
    says(DECISIONS, "ten-node tetrahedra take", within.0);
    says(DECISIONS, "four-node ones are off by", 100.0 * four.last().unwrap().1);
    says(DECISIONS, "four-node ones are off by 4 % after", four.last().unwrap().0);
    let [with, without] =
        ["with residual flexibility (default)", "without"].map(|name| line("b-modes", name));
    says(
        DECISIONS,
        "eight modes with the residual flexibility give the hand a force within",
        100.0 * with[2].1,
    );
    says(DECISIONS, "same four-node mesh; without it the error is", 100.0 * without[2].1);
    says(DECISIONS, "and with 128 modes still", 100.0 * without.last().unwrap().1);
}

#[test]
fn the_integrators_are_those_of_the_report() {
    let free = |name| 100.0 * line("c-steps-free", name)[0].1;
    let [newmark, alpha] = ["Newmark (the paper's)", "generalized-alpha 0.5"].map(free);
    says(DECISIONS, "A struck bar is off by rounding at 60 Hz, and by", newmark);
    says(DECISIONS, "A struck bar is off by rounding at 60 Hz, and by", alpha);
    let exact = line("c-steps-held", "exact (default)");
    says("CHANGELOG.md", "of the [report](docs/report/report.md) is off by", 100.0 * exact[0].1);
    says("CHANGELOG.md", "of the [report](docs/report/report.md) is off by 0.41,", 100.0 * exact[1].1);
    says(
        "CHANGELOG.md",
        "of the [report](docs/report/report.md) is off by 0.41, 0.12 and",
        100.0 * exact[2].1,
    );
    let mut before = "With `StepSettings::second_order` it is".to_owned();
    for (point, told) in exact.iter().zip(["0.41", "0.12", "0.046"]) {
        says(MEASUREMENTS, &before, 100.0 * point.1);
        before = format!("{before} {told} /");
    }
    says(MEASUREMENTS, "falls only with the step above 240 Hz (", 100.0 * exact[3].1);
    says(MEASUREMENTS, "falls only with the step above 240 Hz (0.021 /", 100.0 * exact[4].1);
}

#[test]
fn the_warp_is_that_of_the_report() {
    let [with, without] = ["warped (default)", "linear, without warp"].map(|name| line("d-warp-bend", name));
    for (name, before) in [
        (MEASUREMENTS, "pulled aside by half its length has an error of"),
        (DECISIONS, "A bar pulled aside by half its length is off by"),
    ] {
        says(name, before, 100.0 * with[4].1);
    }
    says(MEASUREMENTS, "of the length with the warp and", 100.0 * without[4].1);
    says(DECISIONS, "of the length with the warp and", 100.0 * without[4].1);
    says(MEASUREMENTS, "a tenth larger with the warp (", with[2].1);
    says(MEASUREMENTS, "a tenth larger with the warp (4.9e-3 against", without[2].1);
    let ratio = |k: usize| with[k].1 / without[k].1 - 1.0;
    assert!((0.05..0.15).contains(&ratio(1)) && (0.05..0.15).contains(&ratio(2)), "a tenth larger");
    let twist = ["warped (default)", "linear, without warp"].map(|name| line("d-warp-twist", name));
    let times = twist[1].last().unwrap().1 / twist[0].last().unwrap().1;
    says(MEASUREMENTS, "twisted furthest at its end, the error without the warp is", times);
    says(DECISIONS, "twisted furthest at its end, the error without the warp is", times);
    let all = |name: &str| line("d-warp-force", &format!("{name}, all of it")).into_iter().map(|p| p.1);
    let most = all("warped (default)").fold(0.0, f64::max);
    let least = all("linear, without warp").fold(f64::INFINITY, f64::min);
    let largest = all("linear, without warp").fold(0.0, f64::max);
    for name in [MEASUREMENTS, DECISIONS] {
        says(name, "with a force of up to", most);
        says(name, "loads (without the warp:", least);
        says(name, &format!("loads (without the warp: {least:.0} to"), largest);
    }
}

/// The tip of a slender bar in pure bending, beside the circle that it really is (Choi and Ko's
/// warp turns every place by the linear rotation of the bending mode).
#[test]
fn a_bent_bar_is_off_by_what_the_theory_says() {
    let off = |degrees: f64, warped: bool| {
        let t = degrees.to_radians();
        let real = [t.sin() / t - 1.0, (1.0 - t.cos()) / t];
        let shown = if warped { [-(1.0 - t.cos()) / 2.0, t.sin() / 2.0] } else { [0.0, t / 2.0] };
        100.0 * (shown[0] - real[0]).hypot(shown[1] - real[1])
    };
    let before = "pure bending is off by";
    says(LIMITS, before, off(30.0, true));
    says(LIMITS, &format!("{before} 2 /"), off(60.0, true));
    says(LIMITS, &format!("{before} 2 / 9 /"), off(90.0, true));
    let before = "of the bar's length (without warping by";
    says(LIMITS, before, off(30.0, false));
    says(LIMITS, &format!("{before} 5 /"), off(60.0, false));
    says(LIMITS, &format!("{before} 5 / 18 /"), off(90.0, false));
}

#[test]
fn the_elasticities_are_those_of_the_report() {
    let at = |line_of: &str, way: u32| {
        line("h-elasticity-hand", &format!("{line_of}, led by {way} % of the length"))
    };
    let best = |all: &[(f64, f64)]| 100.0 * all.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
    let [near, far] = [8, 28].map(|way| at("linear", way));
    let before = "leads by 8 and 28 % of its length, its force is off by";
    says(DECISIONS, before, best(&near));
    says(DECISIONS, &format!("{before} 5 and"), best(&far));
    says(DECISIONS, "% at best, and by", 100.0 * near.last().unwrap().1);
    says(DECISIONS, "% at best, and by 33 and", 100.0 * far.last().unwrap().1);
    let [near, far] = [8, 28].map(|way| at("reduced, with the patch's own shapes", way));
    says(DECISIONS, "with the patch's own shapes is off by", best(&near));
    says(DECISIONS, "with the patch's own shapes is off by 0.1 and", best(&far));
    let times = near.last().unwrap().0 / at("linear", 8).last().unwrap().0;
    says(DECISIONS, "with 36 coordinates at some", times);
    says(PERFORMANCE, "A step of it, held by a hand, costs some", times);
    let own = "reduced, with the patch's own shapes";
    says(PERFORMANCE, "with own shapes and the surface, took", at(own, 8).last().unwrap().0 / 60.0);
    // Other bodies, in motion.
    let took = |hands: &str| number(&row(MEASUREMENTS, &format!("| {hands} |"))[2]).0;
    says(PERFORMANCE, "40 coordinates took", took("one, with the own shapes of its patch"));
    says(DECISIONS, "which was made later, it takes", took("one, with the own shapes of its patch"));
    says(PERFORMANCE, "81 us with a hand's own shapes and", took("two, with their own shapes"));
    says(PERFORMANCE, "109 us with those of two hands,", took("one"));
    says(PERFORMANCE, "109 us with those of two hands, 66 and", took("two"));
    // A hand at a corner, with each number of coordinates.
    let errors =
        |name: &str, way: u32| range(&at(name, way).iter().map(|point| 100.0 * point.1).collect::<Vec<_>>());
    says_range(LIMITS, "with 12 to 36 coordinates it is off by", errors("reduced", 8));
    says_range(LIMITS, "it is off by 1.9 to 4.9 % at 8 % and by", errors("reduced", 28));
    says_range(LIMITS, "at 28 % without the patch's own shapes, and by", errors(own, 8));
    says_range(LIMITS, "own shapes, and by 0.1 to 1.5 % and", errors(own, 28));
    let corner = row(LIMITS, "  | leads a corner of the end sideways by 8 / 28 %");
    assert_eq!(corner[2], "0.1 to 1.5 / 0.3 to 2.4 %");
    assert_eq!(corner[3], "1.9 to 4.9 / 7.9 to 16.6 %");
}

#[test]
fn the_speed_of_a_surface_is_that_of_the_report() {
    let table = row(REPORT, "| armadillo |");
    says(MEASUREMENTS, "the armadillo (120 modes, 4,394 vertices) reaches", number(&table[8]).0);
    let [bunny, most] =
        ["| bunny |", "| own body, for the dragon |"].map(|row_of| number(&row(REPORT, row_of)[4]).0);
    for (page, of_bunny, of_most) in [
        ("docs/baking.md", "linear tetrahedra and 60 modes bakes in", "96,863 tetrahedra and 100 modes take"),
        (DECISIONS, "**A bake takes seconds:**", "49,538 linear tetrahedra and 60 modes,"),
        (MEASUREMENTS, "60 modes | 2.57 s |", "100 modes | 8.23 s |"),
    ] {
        says(page, of_bunny, bunny);
        says(page, of_most, most);
    }
    says(PERFORMANCE, "seconds, once:", bunny);
    says(MEASUREMENTS, "the paper's steps a second in single precision, at", number(&table[9]).0);
    says(MEASUREMENTS, "% of the speed of the memory, and", number(&table[11]).0);
    let [half, single] = ["f16 basis", "f32 basis (drawn at its rounding)"].map(|name| {
        let points = line("e-precision", name);
        points[0]
    });
    says(MEASUREMENTS, "The error of a half-precision basis is", half.1);
    says(DECISIONS, "A half-precision basis is off by", half.1);
    says(DECISIONS, "of the length, and the surface of a bar of 3,170 vertices and 60 modes takes", half.0);
    says(DECISIONS, "60 modes takes 48 us instead of", single.0);
    says(PERFORMANCE, "3,170 vertices and 60 modes took", single.0);
}

//! What README, limits, decisions and questions say of the report's last part, of its part on
//! contact, and of what takes how long.

use crate::page::{
    DECISIONS, LIMITS, MEASUREMENTS, PERFORMANCE, QUESTIONS, REPORT, TRIED, cells, line, number, page, range,
    read, row, says, says_range,
};

const README: &str = "README.md";
const CHANGELOG: &str = "CHANGELOG.md";
const CONTACT: &str = "docs/contact.md";

/// The cells of the rows of a table in a text, which begins with the first row that has `head`.
fn table(text: &str, head: &str) -> Vec<Vec<String>> {
    let rows = text.lines().skip_while(|line| !line.starts_with(head)).skip(2);
    let rows = rows.take_while(|line| line.starts_with('|'));
    rows.map(|row| row.trim_matches('|').split(" | ").map(|cell| cell.trim().to_owned()).collect()).collect()
}

/// A pull of the report's last part, in %.
struct Pull {
    by: f64,
    /// The largest error of the surface, and without what makes it better.
    surface: f64,
    bare_surface: f64,
    along: f64,
    whole: f64,
    bare_whole: f64,
    step_us: f64,
}

/// The pulls of the last part: of the four-node body, of the ten-node one, and of the reduced one.
fn pulls() -> [Vec<Pull>; 3] {
    let report = read(REPORT);
    let (_, part) = report.split_once("## The default at run time").unwrap();
    let (four, rest) = part.split_once("ten-node tetrahedra (the default of the bake)").unwrap();
    let (ten, reduced) = rest.split_once("as it is baked by default: reduced elasticity").unwrap();
    [four, ten, reduced].map(|text| {
        let rows = table(text, "| pulled by, % of the size |");
        let of = |row: &Vec<String>| {
            let after = |cell: usize, mark: char| number(row[cell].split_once(mark).unwrap().1).0;
            Pull {
                by: number(&row[0]).0,
                surface: after(1, '/'),
                bare_surface: number(&row[2]).0,
                along: number(&row[3]).0,
                whole: after(3, '('),
                bare_whole: after(4, '('),
                step_us: number(&row[5]).0,
            }
        };
        rows.iter().map(of).collect()
    })
}

#[test]
fn linear_bodies_are_told_with_the_force_that_they_have() {
    let [four, ..] = pulls();
    let small = &four[0];
    let bent = line("d-warp-force", "warped (default), all of it")[0];
    let size = "bunny is pulled by";
    for name in [README, LIMITS] {
        says(name, size, small.by);
    }
    says(README, "bunny is pulled by 2 % of its size, it is off by", small.along);
    says(README, "moving sideways is off by", small.whole);
    says(LIMITS, "the force along the pull is off by", small.along);
    says(LIMITS, "% and the whole force by", small.whole);
    says(LIMITS, "the end is pulled aside by", 100.0 * bent.0);
    says(LIMITS, "of the length, it is off by", bent.1);
    // "Their shapes are right": nothing that is drawn is off by more than a twentieth of the pull.
    assert!(four.iter().all(|pull| pull.surface < 0.05 * pull.by), "shapes");
    // "And so is the force along a small pull", and of no other.
    assert!(small.along < 5.0 && four[1..].iter().all(|pull| pull.along > 5.0), "forces");
}

#[test]
fn a_step_takes_as_long_as_the_pages_say() {
    let readme = page(README);
    assert!(
        readme.contains("microseconds with linear elasticity, and about a tenth of a millisecond with what")
    );
    let [four, ten, reduced] = pulls();
    let linear = range(&four.iter().chain(&ten).map(|pull| pull.step_us).collect::<Vec<_>>());
    let reduced = range(&reduced.iter().map(|pull| pull.step_us).collect::<Vec<_>>());
    assert!(linear[0] >= 1.0 && linear[1] < 10.0, "microseconds: {linear:?}");
    let tenth = |us: f64| (75.0..125.0).contains(&us);
    assert!(reduced.into_iter().all(tenth), "a tenth of a millisecond: {reduced:?}");
    // The same in other tables.
    let took = |hands: &str| number(&row(MEASUREMENTS, &format!("| {hands} |"))[2]).0;
    says(CHANGELOG, "that was made later it takes", took("one, with the own shapes of its patch"));
    says(CHANGELOG, "us with a hand's own shapes and", took("one"));
    let crowd = |start: &str| {
        let cell = row(MEASUREMENTS, start)[2].clone();
        range(&cell.split(", ").map(|us| number(us).0).collect::<Vec<_>>())
    };
    says_range(PERFORMANCE, "systems of the plugin, each took", crowd("| 20 modes, under gravity |"));
    says_range(
        PERFORMANCE,
        "each took 2.1 to 2.4 us, and",
        crowd("| 20 modes, under gravity, a hand each |"),
    );
    says(PERFORMANCE, "1,036 drawn vertices, took", 7.1);
    says(MEASUREMENTS, "reconstruction of 1,036 vertices and 20 modes took", 7.1);
}

#[test]
fn a_small_patch_is_told_as_it_was_measured() {
    let [.., reduced] = pulls();
    let far = &reduced[1];
    says(LIMITS, "a patch of radius 0.06, pulled by", far.by);
    says(LIMITS, "of the size, has a whole force that is off by", far.whole);
    says(QUESTIONS, "which a small patch pulls by", far.by);
    says(QUESTIONS, "has a whole force that is off by", far.whole);
    says(QUESTIONS, "with the patch's own shapes and by", far.bare_whole);
    let times = far.bare_surface / far.surface;
    assert!(page(QUESTIONS).contains("the shape is three times as near with them"));
    assert!((2.5..3.5).contains(&times), "three times as near: {times}");
}

/// The known answers of part i: case, exact and Pliant's.
fn answers() -> Vec<(String, f64, f64)> {
    let report = read(REPORT);
    let rows = table(&report, "| case | known from |");
    assert!(rows.len() >= 25, "{rows:?}");
    rows.iter().map(|row| (row[0].clone(), row[3].parse().unwrap(), row[4].parse().unwrap())).collect()
}

#[test]
fn a_ball_that_touches_is_told_as_the_part_on_contact_has_it() {
    let answers = answers();
    let answer = |case: String| {
        let found = answers.iter().find(|answer| answer.0.starts_with(&case));
        found.unwrap_or_else(|| panic!("{case}"))
    };
    // The force that presses, over Hertz's at the depth.
    let pressed = |kind: &str| {
        ["0.1", "0.2", "0.3"].map(|share| {
            let (_, force, at_its_depth) = answer(format!("a pressed ball, {kind}, a/R = {share}:"));
            force / at_its_depth
        })
    };
    let [linear, reduced] = ["linear", "reduced"].map(pressed);
    let mut before = "with a force that is".to_owned();
    for (k, told) in ["3 /", "6 /", "9 % larger"].into_iter().enumerate() {
        says(CONTACT, &before, 100.0 * (linear[k] - 1.0));
        before = format!("{before} {told}");
    }
    let mut before = "a/R = 0.1 / 0.2 / 0.3, and".to_owned();
    for (k, told) in ["3 /", "6 /", "12 %"].into_iter().enumerate() {
        says(CONTACT, &before, 100.0 * (reduced[k] - 1.0));
        before = format!("{before} {told}");
    }
    let [least, _] = range(&linear);
    let [_, most] = range(&reduced);
    says(DECISIONS, "The force of a ball at rest is", least);
    says(DECISIONS, "of his at its depth, and up to", most);
    // How long a ball touches depends on the steps in it.
    let time = |steps: u32| {
        let (_, exact, ours) = answer(format!("a ball hits a wall, {steps} steps: time"));
        ours / exact
    };
    // Four directions at four speeds, in hundredths.
    let tried = row(TRIED, "| **one place** | .");
    let tried = tried[1..].iter().flat_map(|cell| cell.split(" to ")).map(|share| number(share).0 / 100.0);
    let all = range(&tried.collect::<Vec<_>>());
    says_range(DECISIONS, "With 64 steps in a contact the time is", all);
    says_range(CHANGELOG, "at 64 steps in a contact, for", all);
    assert!((0.935..0.975).contains(&time(64)), "{}", time(64));
    says(DECISIONS, "with 16 of them the time is", time(16));
    let bounce = read("docs/report/bounce.csv");
    let at_1000: Vec<f64> = bounce
        .lines()
        .map(cells)
        .filter(|row| row[0].starts_with("Pliant") && row[2] == "1000")
        .map(|row| row[3].parse().unwrap())
        .collect();
    let [short, long] = range(&at_1000);
    says(DECISIONS, "a ball of 11.5 ms touches for", short);
    says(DECISIONS, "a ball of 11.5 ms touches for 11 or", long);
}

#[test]
fn a_hand_that_takes_hold_of_what_swings_is_told_as_it_was_measured() {
    let text = read(MEASUREMENTS);
    let rows = table(&text, "| session | who stalls |");
    assert_eq!(rows.len(), 8);
    let [_, most] = range(&rows.iter().map(|row| number(&row[3]).0).collect::<Vec<_>>());
    says(LIMITS, "until the host has told of the hand: up to", most);
}

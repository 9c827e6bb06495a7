//! The part on contact.

use crate::part::Part;

/// The cases, how far each may be off at most, in %.
///
/// Most are rounding, or where a solver stops, and then some times what is measured. A contact
/// lasts whole steps: a sixteenth and a sixty-fourth of it.
const ALLOWED: [(&str, f64); 28] = [
    ("a cube at rest: force of the floor", 1e-7),
    ("the same: depth / size", 1e-7),
    ("on a slope of 0.99 mu: creep a minute / size", 1e-6),
    ("on a slope of 1.01 mu: acceleration", 1e-3),
    ("on a slope of 1.1 mu: acceleration", 1e-4),
    ("on a slope of 2 mu: acceleration", 1e-5),
    ("a ball that slid at 1 m/s rolls", 0.4),
    ("a stack of five cubes: force of the floor", 1e-5),
    ("two cubes meet: momentum lost / exchanged", 1e-11),
    ("the same: angular momentum", 1e-10),
    ("a pressed ball, linear, a/R = 0.1: Hertz's force at its depth", 4.0),
    ("a pressed ball, linear, a/R = 0.2: Hertz's force at its depth", 7.0),
    ("a pressed ball, linear, a/R = 0.3: Hertz's force at its depth", 10.0),
    ("a pressed ball, reduced, a/R = 0.1: Hertz's force at its depth", 4.0),
    ("a pressed ball, reduced, a/R = 0.2: Hertz's force at its depth", 7.0),
    ("a pressed ball, reduced, a/R = 0.3: Hertz's force at its depth", 12.0),
    ("a ball hits a wall, 16 steps: time", 1.0),
    ("a ball hits a wall, 16 steps: force", 7.5),
    ("a ball hits a wall, 16 steps: speed kept", 14.0),
    ("a ball hits a wall, 64 steps: time", 4.0),
    ("a ball hits a wall, 64 steps: force", 2.0),
    ("a ball hits a wall, 64 steps: speed kept", 4.0),
    ("a bar hits a wall, 16 steps: time", 12.6),
    ("a bar hits a wall, 16 steps: force", 1.0),
    ("a bar hits a wall, 16 steps: speed kept", 8.5),
    ("a bar hits a wall, 64 steps: time", 9.0),
    ("a bar hits a wall, 64 steps: force", 1.5),
    ("a bar hits a wall, 64 steps: speed kept", 3.0),
];

#[test]
fn known_answers_of_contact_are_met() {
    let part = Part::of("contact");
    part.table_is_the_csv("i-impact");
    let rows = Part::table(&part.text, "known from");
    assert_eq!(rows.iter().map(|row| row[0]).collect::<Vec<_>>(), ALLOWED.map(|case| case.0));
    for (row, (_, most)) in rows.iter().zip(ALLOWED) {
        let number = |cell: usize| row[cell].parse::<f64>().unwrap();
        let [want, got, off, allowed] = [3, 4, 5, 6].map(number);
        let share = if want == 0.0 { got.abs() } else { (got / want - 1.0).abs() };
        assert!(off <= most && most <= allowed, "{row:?}, {most} is allowed here");
        // What the row says is what its numbers are. They have five decimals, and this one three
        // digits.
        let rounding = 1e-3 + if want == 0.0 { 1e-3 } else { 1e-3 / want.abs() } + 6e-3 * off;
        assert!((100.0 * share - off).abs() <= rounding, "{row:?}");
    }
    // What a step takes, beside others of the same run. A stack of five cubes has more contacts and
    // one system for all of them, and reduced elasticity has its energy besides.
    let us = |case: &str| {
        let found =
            rows.iter().filter(|row| row[0].starts_with(case)).map(|row| row[7].parse::<f64>().unwrap());
        found.fold(f64::INFINITY, f64::min)
    };
    let (one, five) = (us("a cube at rest"), us("a stack of five cubes"));
    assert!((1.0..200.0).contains(&(five / one)), "{five} us for five, {one} us for one");
    let [linear, reduced] = ["linear", "reduced"].map(|kind| us(&format!("a pressed ball, {kind}")));
    assert!((0.6..40.0).contains(&(reduced / linear)), "{reduced} us reduced, {linear} us linear");
    assert!(part.text.contains(&format!("Of {} answers 0 are farther off", rows.len())), "{}", part.text);
    // More steps in a contact come nearer to the closed form.
    for line in ["ball: speed lost", "bar: speed lost"] {
        let points = part.line("i-impact", line);
        assert!(points[1].1 < 0.7 * points[0].1, "{line}: {points:?}");
    }
}

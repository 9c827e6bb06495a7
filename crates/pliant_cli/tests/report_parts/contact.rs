//! The part on contact.

use crate::part::Part;

#[test]
fn known_answers_of_contact_are_met() {
    let part = Part::of("contact");
    part.table_is_the_csv("i-impact");
    let rows = Part::table(&part.text, "known from");
    assert!(rows.len() >= 25, "{rows:?}");
    for row in &rows {
        let number = |cell: usize| row[cell].parse::<f64>().unwrap();
        let [want, got, off, allowed] = [3, 4, 5, 6].map(number);
        let share = if want == 0.0 { got.abs() } else { (got / want - 1.0).abs() };
        assert!(off <= allowed, "{row:?}");
        // What the row says is what its numbers are. They have five decimals, and this one three
        // digits.
        let rounding = 1e-3 + if want == 0.0 { 1e-3 } else { 1e-3 / want.abs() } + 6e-3 * off;
        assert!((100.0 * share - off).abs() <= rounding, "{row:?}");
        assert!(number(7) > 0.0, "{row:?}");
    }
    assert!(part.text.contains(&format!("Of {} answers 0 are farther off", rows.len())), "{}", part.text);
    // More steps in a contact come nearer to the closed form.
    for line in ["ball: speed lost", "bar: speed lost"] {
        let points = part.line("i-impact", line);
        assert!(points[1].1 < 0.7 * points[0].1, "{line}: {points:?}");
    }
}

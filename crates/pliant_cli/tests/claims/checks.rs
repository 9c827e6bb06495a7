//! What the pages say of the stability matrix and of the stiffness of small pulls.

use crate::page::{DECISIONS, MEASUREMENTS, QUESTIONS, number, page, read, row, says};

#[test]
fn the_stability_matrix_is_told_as_its_page_counts_it() {
    let all = row("docs/report/stability.md", "| all |");
    let [cases, kept, limits, dynamics] = [1, 2, 3, 4].map(|cell| number(&all[cell]).0);
    assert_eq!(cases, kept + limits);
    says(DECISIONS, "The stability matrix has", cases);
    says(DECISIONS, &format!("The stability matrix has {cases} cases and"), limits);
    says(DECISIONS, &format!("cases and {limits} known limits.**"), kept);
    says(MEASUREMENTS, "`pliant stability` runs", cases);
    says(MEASUREMENTS, "of the cases state these:", dynamics);
    says(MEASUREMENTS, "within 1e-9 of Coulomb's law. The", limits);
    // Which of its references are ours.
    let full = row("docs/report/stability.md", "| full elements |");
    says(QUESTIONS, "has, in 10 of the", number(&full[1]).0);
    let bounds = read("docs/report/stability.md");
    let cases = |bound: &str| {
        let row = bounds.lines().find_map(|line| line.strip_prefix(bound)).unwrap();
        number(row).0
    };
    let statics = cases(r"| \|reaction - static\| / static |");
    says(QUESTIONS, "\"Static\", in", statics);
    let own = cases(r"| \|reaction - full finite elements\| / full finite elements |");
    assert_eq!([statics, own], [45.0, 13.0]);
    let told = page(MEASUREMENTS);
    assert!(
        told.contains("Forty-five cases compare") && told.contains("and thirteen of those with bad elements")
    );
}

#[test]
fn a_small_pull_feels_the_stiffness_of_the_whole_body_as_often_as_was_measured() {
    let radii = ["0.033", "0.047", "0.067", "0.095", "0.135"];
    let shares: Vec<f64> = radii
        .iter()
        .flat_map(|radius| {
            let row = row(MEASUREMENTS, &format!("| {radius} |"));
            [number(&row[1]).0, number(&row[2]).0]
        })
        .collect();
    let least = shares.iter().copied().fold(f64::INFINITY, f64::min);
    let most = shares.iter().copied().fold(0.0, f64::max);
    let errors = row(MEASUREMENTS, "| worst error |");
    let worst = number(&errors[1]).0.max(number(&errors[2]).0);
    says(DECISIONS, "Of all patches and axes,", least);
    says(DECISIONS, "Of all patches and axes, 94 to", most);
    says(DECISIONS, "of the full static solution; the worst is off by", worst);
    says("docs/concepts.md", "the static stiffness of the whole body within 2 % at", least);
    says("CHANGELOG.md", "full finite-element solution within 2 % at", least);
}

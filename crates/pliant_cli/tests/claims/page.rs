//! What is read of pages, of the report's files and of tables.

use std::path::Path;

/// A page with its lines joined, so that a sentence may be found.
pub(crate) fn page(name: &str) -> String {
    let text = read(name);
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

pub(crate) fn read(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The points of one line of a figure of the report.
pub(crate) fn line(figure: &str, name: &str) -> Vec<(f64, f64)> {
    let csv = read(&format!("docs/report/{figure}.csv"));
    let start = format!("\"{name}\",");
    let points: Vec<(f64, f64)> = csv
        .lines()
        .filter_map(|row| {
            let mut numbers = row.strip_prefix(&start)?.split(',').map(|cell| cell.parse().unwrap());
            Some((numbers.next()?, numbers.next()?))
        })
        .collect();
    assert!(!points.is_empty(), "{name} in {figure}");
    points
}

/// The cells of the first row of a page that begins with `start`.
pub(crate) fn row(name: &str, start: &str) -> Vec<String> {
    let text = read(name);
    let row = text.lines().find(|line| line.starts_with(start));
    let row = row.unwrap_or_else(|| panic!("no row {start} in {name}"));
    row.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect()
}

/// The cells of a row of comma-separated values, of which some are quoted.
pub(crate) fn cells(row: &str) -> Vec<String> {
    let (mut all, mut quoted) = (vec![String::new()], false);
    for letter in row.chars() {
        match letter {
            '"' => quoted = !quoted,
            ',' if !quoted => all.push(String::new()),
            _ => all.last_mut().unwrap().push(letter),
        }
    }
    all
}

/// Least and most.
pub(crate) fn range(values: &[f64]) -> [f64; 2] {
    assert!(!values.is_empty(), "nothing was measured");
    [values.iter().copied().fold(f64::INFINITY, f64::min), values.iter().copied().fold(0.0, f64::max)]
}

/// The first number of a text and the worth of its last digit. Thousands may have commas.
pub(crate) fn number(text: &str) -> (f64, f64) {
    let from = text.find(|c: char| c.is_ascii_digit()).unwrap_or_else(|| panic!("no number in {text}"));
    let number: String =
        text[from..].chars().take_while(|c| c.is_ascii_digit() || ".,e-".contains(*c)).collect();
    let number = number.trim_end_matches(['.', ',', '-', 'e']).replace(',', "");
    let (digits, power) = number.split_once('e').unwrap_or((&number, "0"));
    let scale = 10f64.powi(power.parse().unwrap());
    let decimals = digits.split_once('.').map_or(0, |(_, after)| after.len());
    (digits.parse::<f64>().unwrap() * scale, 10f64.powi(-(decimals as i32)) * scale)
}

/// A page says `before NUMBER`, and the number must be `real`, rounded to its last digit.
pub(crate) fn says(name: &str, before: &str, real: f64) {
    let text = page(name);
    let (_, after) = text.split_once(before).unwrap_or_else(|| panic!("{name} does not say: {before}"));
    let (told, digit) = number(after);
    assert!((told - real).abs() <= 0.5001 * digit, "{name}: {before} {told}, but it is {real}");
}

/// A page says `before LEAST to MOST`.
pub(crate) fn says_range(name: &str, before: &str, [least, most]: [f64; 2]) {
    says(name, before, least);
    let text = page(name);
    let (_, after) = text.split_once(before).unwrap();
    let told = after.trim_start().split(' ').next().unwrap();
    says(name, &format!("{before} {told} to"), most);
}

pub(crate) const MEASUREMENTS: &str = "docs/report/measurements.md";
pub(crate) const DECISIONS: &str = "docs/decisions.md";
pub(crate) const LIMITS: &str = "docs/limits.md";
pub(crate) const PERFORMANCE: &str = "docs/performance.md";
pub(crate) const REPORT: &str = "docs/report/report.md";
pub(crate) const TRIED: &str = "docs/report/tried.md";
pub(crate) const QUESTIONS: &str = "docs/report/questions.md";

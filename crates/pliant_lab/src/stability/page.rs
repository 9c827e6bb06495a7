//! The matrix as a page in Markdown.

use std::fmt::Write;

use super::{StabilityReport, Verdict};

/// The text above the tables.
const HEAD: &str = "\
# The stability matrix

`pliant stability -o docs/report/stability.md` makes this page. A bound compares a measured number
with a limit. The margin is the limit over the number, for the tightest bound of a case: with 1 the
bound just holds. The phases are those of the slowest and the fastest mode in a step. Stiffness,
density, size and step act on the motion through them alone, so that two cases of one script with
the same phases, damping ratios and relaxation are one case for the arithmetic, in other units.

";

impl StabilityReport {
    /// The matrix as a page in Markdown: groups, known limits, and every case with its tightest
    /// bound.
    pub fn page(&self) -> String {
        let mut page = HEAD.to_owned();
        let mut groups: Vec<&'static str> = Vec::new();
        for case in &self.cases {
            if !groups.contains(&case.group) {
                groups.push(case.group);
            }
        }
        let of = |group: &'static str| self.cases.iter().filter(move |case| case.group == group);
        page += "| group | cases | keep their bounds | known limits | pairs of phases | smallest margin |\n";
        page += "| --- | --- | --- | --- | --- | --- |\n";
        let row = |page: &mut String, name: &str, cases: Vec<&Verdict>| {
            let passed = cases.iter().filter(|case| case.passed).count();
            let limits = cases.iter().filter(|case| case.known_limit.is_some()).count();
            let least = cases.iter().filter(|c| c.passed).map(|c| c.margin).fold(f64::INFINITY, f64::min);
            // Writing to a string cannot fail.
            let _ = writeln!(
                page,
                "| {name} | {} | {passed} | {limits} | {} | {} |",
                cases.len(),
                pairs(&cases).map_or_else(|| "-".to_owned(), |n| n.to_string()),
                margin(least)
            );
        };
        for &group in &groups {
            row(&mut page, group, of(group).collect());
        }
        row(&mut page, "all", self.cases.iter().collect());
        page += "\n## Known limits\n";
        let mut reasons: Vec<&'static str> = self.cases.iter().filter_map(|case| case.known_limit).collect();
        reasons.dedup();
        for why in reasons {
            let _ = writeln!(page, "\nThe reason of these: {why}.\n");
            for case in self.cases.iter().filter(|case| case.known_limit == Some(why)) {
                let _ = writeln!(page, "- {}, {}: {}", case.group, case.name, case.bound);
            }
        }
        if self.broken() > 0 {
            page += "\n## Broken\n\n";
            for case in self.cases.iter().filter(|case| case.broken()) {
                let _ = writeln!(page, "- {}, {}: {}", case.group, case.name, case.bound);
            }
        }
        for group in groups {
            let _ = writeln!(page, "\n## {group}\n");
            let beside = of(group).any(|case| case.plain.is_some());
            page += "| case | phases / rad | margin | tightest bound |";
            page += if beside { " the paper's plain scheme |\n" } else { "\n" };
            page += if beside { "| --- | --- | --- | --- | --- |\n" } else { "| --- | --- | --- | --- |\n" };
            for case in of(group) {
                let phases =
                    case.phases.map_or_else(|| "-".to_owned(), |[a, b]| format!("{a:.2e} to {b:.2e}"));
                let mark = match (case.passed, case.known_limit) {
                    (true, _) => "",
                    (false, Some(_)) => " (known limit)",
                    (false, None) => " **broken**",
                };
                let bound = case.bound.replace('|', "\\|");
                let _ =
                    write!(page, "| {}{mark} | {phases} | {} | {bound} |", case.name, margin(case.margin));
                match &case.plain {
                    Some(plain) => {
                        let _ = writeln!(page, " {plain} |");
                    }
                    None if beside => page += " |\n",
                    None => page += "\n",
                }
            }
        }
        page
    }
}

/// The number of pairs of phases among cases, to three digits, if they have phases.
fn pairs(cases: &[&Verdict]) -> Option<usize> {
    let mut all: Vec<String> = cases
        .iter()
        .filter_map(|case| case.phases)
        .map(|[slow, fast]| format!("{slow:.2e} {fast:.2e}"))
        .collect();
    all.sort();
    all.dedup();
    (!all.is_empty()).then_some(all.len())
}

fn margin(margin: f64) -> String {
    if margin >= 1e6 { "> 1e6".to_owned() } else { format!("{margin:.3}") }
}

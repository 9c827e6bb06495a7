//! The matrix as a page in Markdown.

use std::fmt::Write;

use super::{Bound, StabilityReport, Verdict};

/// The text above the stamp.
const HEAD: &str = "\
# The stability matrix

`pliant stability -o docs/report/stability.md` makes this page. A bound compares a measured number
with a limit. The margin is the limit over the number, for the tightest bound of a case: with 1 the
bound just holds. A second table has every bound, with the case that keeps it most narrowly. The
phases are those of the slowest and the fastest mode in a step, and zeta is the damping ratio of
these (one number where both have the same). Stiffness, density, size and step act on the motion
through phases, damping ratios and relaxation alone, so that two cases of one script that have these
alike are one case for the arithmetic, in other units. The column of dynamics counts those that
differ. Numbers far below 1e-9 are rounding, and differ from processor to processor. A tool at 0 m/s
is held by the friction of its device, 0.26 N as in a Touch, but where a case has none.

The references of forces are these:

- `|reaction - static|` is measured from the compliance of the body itself, its modes and its baked
  flexibilities. It shows what the steps do, and not what the bake left out.
- Full finite elements of linear elasticity are those of
  `crates/pliant_lab/src/stability/solid.rs`. They were written for the matrix, share no line with
  those of the bake, and have Timoshenko's beam beside them.
- Reduced elasticity has the full solution of the bake itself, `deflect`, beside it. It shows what
  the reduction leaves out, and no fault that both have.
- A falling block is measured from a column under its own weight, whose center sinks by
  rho g H^2 / (3 E).
- Without friction, the force of a device at rest is that of the coupling and of full finite
  elements, one after the other. The coupling has the stiffness to which it is set, so that a
  setting that is wrong does not show there.

Over networks, the paper's repair and none stand beside the default. They have its three repeats and
its playout delay of one tick, and the paper's integrator at both ends. What they show is told and
has no bound.

";

impl StabilityReport {
    /// The matrix as a page in Markdown: groups, known limits, and every case with its tightest
    /// bound.
    pub fn page(&self) -> String {
        let mut page = HEAD.to_owned();
        let _ = writeln!(page, "{}\n", self.made);
        let mut groups: Vec<&'static str> = Vec::new();
        for case in &self.cases {
            if !groups.contains(&case.group) {
                groups.push(case.group);
            }
        }
        let of = |group: &'static str| self.cases.iter().filter(move |case| case.group == group);
        page += "| group | cases | keep their bounds | known limits | dynamics | smallest margin |\n";
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
                dynamics(&cases).map_or_else(|| "-".to_owned(), |n| n.to_string()),
                margin(least)
            );
        };
        for &group in &groups {
            row(&mut page, group, of(group).collect());
        }
        row(&mut page, "all", self.cases.iter().collect());
        self.bounds(&mut page);
        page += "\n## Known limits\n\nA known limit breaks a bound for a reason. It passes if each number that breaks its bound is\nwithin its range, and all others keep theirs. Any other result fails, a better one too.\n";
        let mut reasons: Vec<&'static str> = Vec::new();
        for why in self.cases.iter().filter_map(|case| case.known_limit) {
            if !reasons.contains(&why) {
                reasons.push(why);
            }
        }
        for why in reasons {
            let _ = writeln!(page, "\nThe reason of these: {why}.\n");
            page += "| case | number | measured | bound | may be |\n| --- | --- | --- | --- | --- |\n";
            for case in self.cases.iter().filter(|case| case.known_limit == Some(why)) {
                let name = format!("{}, {}", case.group, case.name);
                if case.permitted.is_empty() {
                    let _ = writeln!(page, "| {name} | {} | | | refused |", case.bound.replace('|', "\\|"));
                }
                for (what, low, high) in &case.permitted {
                    for bound in case.bounds.iter().filter(|bound| bound.what == *what) {
                        let what = what.replace('|', "\\|");
                        let (got, limit) = (bound.measured, bound.limit);
                        let _ =
                            writeln!(page, "| {name} | {what} | {got:.3e} | {limit:.3e} | {low} to {high} |");
                    }
                }
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
            let beside = of(group).find(|case| case.plain.is_some());
            page += "| case | phases / rad, zeta | margin | tightest bound |";
            page += &beside.map_or_else(|| "\n".to_owned(), |case| format!(" {} |\n", case.papers_way()));
            let beside = beside.is_some();
            page += if beside { "| --- | --- | --- | --- | --- |\n" } else { "| --- | --- | --- | --- |\n" };
            for case in of(group) {
                let phases = motion(case).unwrap_or_else(|| "-".to_owned());
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

    /// Every bound with the case that keeps it with the smallest margin.
    fn bounds(&self, page: &mut String) {
        *page += "\n## Bounds\n\n| bound | cases | smallest margin | of | in | limits |\n";
        *page += "| --- | --- | --- | --- | --- | --- |\n";
        let all = || self.cases.iter().flat_map(|case| case.bounds.iter().map(move |bound| (case, bound)));
        let mut names: Vec<&'static str> = Vec::new();
        for (_, bound) in all() {
            if !names.contains(&bound.what) {
                names.push(bound.what);
            }
        }
        for name in names {
            let of = || all().filter(|(_, bound)| bound.what == name);
            let kept = |bound: &Bound| bound.margin() >= 1.0;
            let nearest =
                of().filter(|(_, bound)| kept(bound)).min_by(|a, b| a.1.margin().total_cmp(&b.1.margin()));
            let limits = of().map(|(_, bound)| bound.limit);
            let (least, most) = (limits.clone().fold(f64::INFINITY, f64::min), limits.fold(0.0, f64::max));
            let limits =
                if least == most { format!("{least:.3e}") } else { format!("{least:.3e} to {most:.3e}") };
            let what = name.replace('|', "\\|");
            let nearest = nearest.map_or_else(
                || "- | - | none keeps it".to_owned(),
                |(case, bound)| {
                    let (margin, got, limit) = (margin(bound.margin()), bound.measured, bound.limit);
                    format!("{margin} | measured {got:.3e} <= {limit:.3e} | {}, {}", case.group, case.name)
                },
            );
            // Writing to a string cannot fail.
            let _ = writeln!(page, "| {what} | {} | {nearest} | {limits} |", of().count());
        }
    }
}

/// What the motion of a case depends on, to three digits: phases, damping ratios and relaxation.
fn motion(case: &Verdict) -> Option<String> {
    let [slow, fast] = case.phases?;
    let mut text = format!("{slow:.2e} to {fast:.2e}");
    // Writing to a string cannot fail.
    if let Some([first, last]) = case.damping.map(|zeta| zeta.map(|zeta| (1e3 * zeta).round() / 1e3)) {
        let _ = if first == last {
            write!(text, ", zeta {first}")
        } else {
            write!(text, ", zeta {first} to {last}")
        };
    }
    if let Some([ratio, steps]) = case.relaxation {
        let _ = write!(text, ", {ratio} relaxes in {steps:.2e} steps");
    }
    Some(text)
}

/// The number of different motions among cases, if they tell theirs.
fn dynamics(cases: &[&Verdict]) -> Option<usize> {
    let mut all: Vec<String> = cases.iter().filter_map(|case| motion(case)).collect();
    all.sort();
    all.dedup();
    (!all.is_empty()).then_some(all.len())
}

fn margin(margin: f64) -> String {
    if margin >= 1e6 { "> 1e6".to_owned() } else { format!("{margin:.3}") }
}

//! A part of the report that has been run, and what is read of it.

use crate::support::{Folder, json, succeeds};

/// One part of the report that has been run.
pub(crate) struct Part {
    pub(crate) folder: Folder,
    pub(crate) text: String,
}

impl Part {
    pub(crate) fn of(name: &str) -> Self {
        let folder = Folder::new(&format!("part-{name}"));
        let out = folder.file("out");
        // The page has this part already, and another one, which has to stay.
        let [modes, precision] = ["b. Modes kept", "e1. Precision"];
        let other = if name == "modes" { precision } else { modes };
        std::fs::create_dir_all(folder.0.join("out")).unwrap();
        let page = folder.0.join("out/report.md");
        let goes = match name {
            "modes" => modes,
            "precision" => precision,
            _ => "Of another program",
        };
        let old = format!("# Old\n\n## {other}\n\nIt stays.\n\n## {goes}\n\nIt goes.\n");
        std::fs::write(&page, old).unwrap();
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
        let text = std::fs::read_to_string(page).unwrap();
        assert!(text.contains(&format!("## {other}\n\nIt stays.\n")) && !text.contains("It goes."), "{text}");
        // Each part says how it was made.
        assert!(text.contains(&format!("by `pliant report --only {name} --quick`: Pliant ")), "{text}");
        Self { folder, text }
    }

    /// Name of the line, x and y of each point of a figure.
    pub(crate) fn points(&self, figure: &str) -> Vec<(String, f64, f64)> {
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

    pub(crate) fn line(&self, figure: &str, name: &str) -> Vec<(f64, f64)> {
        let points = self.points(figure);
        let line: Vec<_> = points.iter().filter(|p| p.0 == name).map(|p| (p.1, p.2)).collect();
        assert!(!line.is_empty(), "{name} in {points:?}");
        line
    }
}

impl Part {
    /// The text of a figure, up to the next one.
    pub(crate) fn section(&self, figure: &str) -> &str {
        let (_, after) = self.text.split_once(&format!("({figure}.svg)")).unwrap();
        after.split("\n![").next().unwrap()
    }

    /// The rows of the first table in a text whose header contains `head`, as cells.
    pub(crate) fn table<'a>(text: &'a str, head: &str) -> Vec<Vec<&'a str>> {
        let rows = text.lines().skip_while(|line| !(line.starts_with('|') && line.contains(head)));
        let rows = rows.skip(2).take_while(|line| line.starts_with('|'));
        let cells = |line: &'a str| line.trim_matches('|').split(" | ").map(str::trim).collect();
        let rows: Vec<Vec<&str>> = rows.map(cells).collect();
        assert!(!rows.is_empty(), "{head} in {text}");
        rows
    }

    /// The table below a figure must have the points of its CSV file: each line, x and y.
    pub(crate) fn table_is_the_csv(&self, figure: &str) {
        let points = self.points(figure);
        let rows = Self::table(self.section(figure), "| line |");
        assert_eq!(rows.len(), points.len(), "{figure}");
        for (row, (name, x, y)) in rows.iter().zip(&points) {
            let number = |cell: usize| row[cell].parse::<f64>().unwrap();
            let (told_x, told_y) = (number(1), number(row.len() - 1));
            assert_eq!(row[0], name, "{figure}");
            // The text has four decimals of x and three digits of y.
            assert!((told_x - x).abs() <= 1.1e-4 + 1e-3 * x.abs(), "{figure}: {row:?}, {x}");
            assert!((told_y - y).abs() <= 1e-2 * y.abs(), "{figure}: {row:?}, {y}");
        }
    }
}

/// The number after `before` in a text, up to a character that no number has.
pub(crate) fn number_after(text: &str, before: &str) -> f64 {
    let (_, after) = text.split_once(before).unwrap_or_else(|| panic!("{before} in {text}"));
    let end = after.find(|c: char| !(c.is_ascii_digit() || "+-.e".contains(c))).unwrap_or(after.len());
    after[..end].trim_end_matches('.').parse().unwrap_or_else(|e| panic!("{before}: {e} in {after}"))
}

/// A row of a table of pulls. Distances are % of the size, forces % of the load.
#[derive(Debug)]
pub(crate) struct Pulled {
    pub(crate) by: f64,
    /// Error of the surface: root mean square and largest.
    pub(crate) rms: f64,
    pub(crate) most: f64,
    /// Error of the force: along the pull, and all of it.
    pub(crate) along: f64,
    pub(crate) whole: f64,
    /// The largest error of the surface and the whole one of the force without the warp, or without
    /// the patch's own shapes.
    pub(crate) bare_most: f64,
    pub(crate) bare_whole: f64,
    pub(crate) step_us: f64,
}

impl Pulled {
    pub(crate) fn of(row: &[&str]) -> Self {
        let number = |cell: usize| number_after(row[cell], "");
        let [whole, bare_whole] = [3, 4].map(|cell| number_after(row[cell], "("));
        let most = number_after(row[1], " / ");
        Self {
            by: number(0),
            rms: number(1),
            most,
            along: number(3),
            whole,
            bare_most: number(2),
            bare_whole,
            step_us: number(5),
        }
    }
}

pub(crate) fn last(line: &[(f64, f64)]) -> f64 {
    line.last().unwrap().1
}

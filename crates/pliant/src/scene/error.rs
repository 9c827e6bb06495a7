//! Errors of a scene: what is wrong, where, and what was expected.

use std::fmt;

/// Why a scene was refused: the file, the line, the column and what was expected.
///
/// ```text
/// scenes/solo.ron:5:34: unknown field `modle` in Body; did you mean `model`?
///   5 |         (name: "pip", color: (1, 0, 0), modle: "pip.modal"),
///     |                                          ^
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneError {
    /// The path of the file, or the name of the text.
    pub file: String,
    /// Line and column, from 1, in characters.
    ///
    /// `None` without a text: for a file that cannot be read, or a scene made in code.
    pub position: Option<(usize, usize)>,
    /// The kind of the mistake.
    pub kind: SceneErrorKind,
    /// What was expected and what was found.
    pub message: String,
    /// The line of the text, if there is a text.
    pub(super) line: String,
}

/// The kinds of mistakes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SceneErrorKind {
    /// The file cannot be read, is not text, or is too long.
    Read,
    /// The text is not RON, or a value has the wrong type.
    Syntax,
    /// A field or a variant is unknown, or a field is missing.
    Field,
    /// A value is out of its range.
    Value,
    /// A name is defined twice, or refers to nothing.
    Name,
    /// A file that the scene names is missing or invalid.
    Asset,
    /// The program or the app lacks a feature that the scene asks for.
    Feature,
    /// A socket, a device or a file cannot be opened.
    Open,
}

/// Maximum length of the part of a line that an error shows, characters.
const SHOWN: usize = 100;

impl SceneError {
    /// Creates an error at a byte of a text.
    pub(super) fn at(file: &str, text: &str, byte: usize, kind: SceneErrorKind, message: String) -> Self {
        let position = super::locate::line_and_column(text, byte);
        Self::at_position(file, text, position, kind, message)
    }

    /// Creates an error at a line and a column of a text.
    pub(super) fn at_position(
        file: &str,
        text: &str,
        position: (usize, usize),
        kind: SceneErrorKind,
        message: String,
    ) -> Self {
        let line = text.lines().nth(position.0.saturating_sub(1)).unwrap_or_default();
        // The line is cut after the caret, so that a file of one very long line is not copied.
        let line = line.chars().take(position.1.saturating_add(SHOWN)).collect();
        Self { file: file.into(), position: Some(position), kind, message, line }
    }

    /// Creates an error without a position in a text.
    pub(super) fn without_place(file: &str, kind: SceneErrorKind, message: String) -> Self {
        Self { file: file.into(), position: None, kind, message, line: String::new() }
    }
}

impl fmt::Display for SceneError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some((line, column)) = self.position else {
            return write!(f, "{}: {}", self.file, self.message);
        };
        write!(f, "{}:{line}:{column}: {}", self.file, self.message)?;
        if self.line.trim().is_empty() {
            return Ok(());
        }
        // Shows the part of a long line around the caret. A tab counts as one column, as in the
        // position.
        let from = (column - 1).saturating_sub(SHOWN - 20);
        let part: String =
            self.line.chars().skip(from).take(SHOWN).map(|c| if c.is_control() { ' ' } else { c }).collect();
        let number = line.to_string();
        let margin = " ".repeat(number.len());
        let caret = " ".repeat(column - 1 - from);
        write!(f, "\n  {number} | {}\n  {margin} | {caret}^", part.trim_end())
    }
}

impl std::error::Error for SceneError {}

/// Returns the one of `names` that `wrong` was most likely meant to be.
pub(super) fn nearest<'a>(wrong: &str, names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let most = (wrong.chars().count() / 3).clamp(1, 3);
    let distances = names.into_iter().take(1000).map(|name| (distance(wrong, name, most), name));
    distances.filter(|(distance, _)| *distance <= most).min().map(|(_, name)| name)
}

/// Returns the optimal string alignment distance of two names if it is at most `most`.
///
/// Changed, extra and missing letters count, and so do swaps of neighboring letters.
fn distance(a: &str, b: &str, most: usize) -> usize {
    let [a, b]: [Vec<char>; 2] = [a, b].map(|s| s.to_lowercase().chars().take(80).collect());
    if a.len().abs_diff(b.len()) > most {
        return most + 1;
    }
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 1..=a.len() {
        let mut row = vec![i];
        for j in 1..=b.len() {
            let same = usize::from(a[i - 1] != b[j - 1]);
            let mut least = (rows[i - 1][j] + 1).min(row[j - 1] + 1).min(rows[i - 1][j - 1] + same);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                least = least.min(rows[i - 2][j - 2] + 1);
            }
            row.push(least);
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_of_the_finger_is_understood() {
        assert_eq!(nearest("modle", ["name", "model", "modes"]), Some("model"));
        assert_eq!(nearest("Newmrak", ["Exact", "Newmark"]), Some("Newmark"));
        assert_eq!(nearest("speed", ["name", "model"]), None);
    }
}

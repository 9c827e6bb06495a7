//! Turns the errors of the RON parser into messages for people who write scenes.

use ron::{Error, error::SpannedError};

use super::error::nearest;
use super::{SceneError, SceneErrorKind};

/// Returns the parser's error as a scene error with a readable message.
pub(super) fn refused(origin: &str, text: &str, error: &SpannedError) -> SceneError {
    let start = error.span.start;
    let inside =
        |outer: &Option<String>| outer.as_ref().map_or(String::new(), |outer| format!(" in {outer}"));
    let listed = |names: &[&str]| names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
    let wrong = |what: &str, found: &str, outer: &Option<String>, names: &'static [&'static str]| {
        let excerpt: String = found.chars().take(80).collect();
        let names_there = listed(names);
        match nearest(found, names.iter().copied()) {
            Some(near) => {
                format!(
                    "unknown {what} `{excerpt}`{}; did you mean `{near}`? There are {names_there}",
                    inside(outer)
                )
            }
            None => format!("unknown {what} `{excerpt}`{}; expected one of {names_there}", inside(outer)),
        }
    };
    let (kind, message) = match &error.code {
        Error::NoSuchStructField { expected, found, outer } => {
            (SceneErrorKind::Field, wrong("field", found, outer, expected))
        }
        Error::NoSuchEnumVariant { expected, found, outer } => {
            (SceneErrorKind::Field, wrong("value", found, outer, expected))
        }
        Error::MissingStructField { field, outer } => {
            (SceneErrorKind::Field, format!("the field `{field}` is missing{}", inside(outer)))
        }
        Error::DuplicateStructField { field, outer } => {
            (SceneErrorKind::Field, format!("the field `{field}` is there twice{}", inside(outer)))
        }
        Error::ExceededRecursionLimit => {
            (SceneErrorKind::Syntax, "brackets are nested deeper than any scene's".to_owned())
        }
        _ if text.trim().is_empty() => {
            (SceneErrorKind::Syntax, "the file is empty; expected a scene: `(bodies: [..])`".to_owned())
        }
        other => (SceneErrorKind::Syntax, in_words(other, after(text, start.line, start.col))),
    };
    SceneError::at_position(origin, text, (start.line, start.col), kind, message)
}

/// Returns the text from a line and a column on, both from 1.
///
/// The result includes the minus sign that the parser has read before it refused a number.
fn after(text: &str, line: usize, column: usize) -> &str {
    let begin: usize = text.split_inclusive('\n').take(line.saturating_sub(1)).map(str::len).sum();
    let rest = text.get(begin..).unwrap_or_default();
    let skipped: usize = rest.chars().take(column.saturating_sub(1)).map(char::len_utf8).sum();
    let skipped = skipped - usize::from(rest.get(..skipped).is_some_and(|read| read.ends_with('-')));
    rest.get(skipped..).unwrap_or_default()
}

/// Returns what was expected and what the text has instead.
fn in_words(error: &Error, rest: &str) -> String {
    let expected = match error {
        // The parser has read the number up to its decimal point.
        Error::ExpectedComma if rest.starts_with('.') => "expected a whole number",
        Error::ExpectedComma => "expected a comma or a closing bracket",
        Error::ExpectedFloat => "expected a number",
        Error::ExpectedInteger | Error::IntegerOutOfBounds | Error::InvalidIntegerDigit { .. } => {
            "expected a whole number, 0 or more"
        }
        Error::ExpectedBoolean => "expected true or false",
        Error::ExpectedString => "expected text in double quotes",
        Error::ExpectedArray => "expected a list in square brackets",
        Error::ExpectedArrayEnd => "expected a comma or a closing bracket `]`",
        Error::ExpectedStructLikeEnd => "expected a comma or a closing bracket `)`",
        Error::ExpectedStructLike => {
            "expected an opening bracket (what has parts has brackets of its own, such as `Toward((1, 0, 0))`)"
        }
        Error::ExpectedMapColon => "expected a colon after the field's name",
        Error::ExpectedIdentifier => "expected a name",
        Error::Eof => return "the file ends too early; expected a value or a closing bracket".into(),
        // Some errors repeat the text that they found, which can be very long.
        other => return other.to_string().chars().take(400).collect(),
    };
    let rest = rest.trim_start();
    let ends = |c: char| c.is_whitespace() || [',', ')', ']', '}', ':'].contains(&c);
    let mut word: String = rest.chars().take_while(|c| !ends(*c)).take(40).collect();
    if word.is_empty() {
        word.extend(rest.chars().next());
    }
    if word.is_empty() {
        return format!("{expected}, got the end of the file");
    }
    format!("{expected}, got `{word}`")
}

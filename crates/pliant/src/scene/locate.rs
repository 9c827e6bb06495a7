//! Finds where a value begins in a RON text.
//!
//! A parser reports where the text is malformed. This module finds the position of a value that
//! parsed well but fails a later check.

/// A step from a value to a value inside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// The field of this name.
    Field(&'static str),
    /// The element of this index in a list, a tuple or a variant's brackets.
    Item(usize),
}

/// Returns the byte at which the value at `path` begins in a well-formed text.
///
/// If the value was left out, the result is the beginning of the innermost value of the path that
/// exists. A malformed text gives some byte of the text.
pub(super) fn locate(text: &str, path: &[Step]) -> usize {
    let mut cursor = TextCursor { text, at: 0 };
    cursor.space();
    while cursor.text[cursor.at..].starts_with("#!") {
        cursor.attribute();
        cursor.space();
    }
    let mut found = cursor.at;
    for step in path {
        match cursor.enter(*step) {
            Some(at) => found = at,
            None => break,
        }
    }
    found
}

/// Returns the line and the column of a byte, both from 1, in characters.
pub(super) fn line_and_column(text: &str, at: usize) -> (usize, usize) {
    let mut at = at.min(text.len());
    while !text.is_char_boundary(at) {
        at -= 1;
    }
    let before = &text[..at];
    let begin = before.rfind('\n').map_or(0, |newline| newline + 1);
    (1 + before.matches('\n').count(), 1 + before[begin..].chars().count())
}

struct TextCursor<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> TextCursor<'a> {
    fn rest(&self) -> &'a str {
        &self.text[self.at..]
    }

    fn peek(&self) -> Option<char> {
        self.rest().chars().next()
    }

    fn eat(&mut self, wanted: char) -> bool {
        let there = self.peek() == Some(wanted);
        if there {
            self.at += wanted.len_utf8();
        }
        there
    }

    /// Skips white space and comments.
    fn space(&mut self) {
        loop {
            let rest = self.rest();
            let trimmed = rest.trim_start();
            self.at += rest.len() - trimmed.len();
            if trimmed.starts_with("//") {
                self.at += trimmed.find('\n').unwrap_or(trimmed.len());
            } else if trimmed.starts_with("/*") {
                self.block_comment();
            } else {
                return;
            }
        }
    }

    /// Skips a block comment. Block comments nest.
    fn block_comment(&mut self) {
        let mut depth = 0_usize;
        while !self.rest().is_empty() {
            if self.rest().starts_with("/*") {
                depth += 1;
                self.at += 2;
            } else if self.rest().starts_with("*/") {
                depth -= 1;
                self.at += 2;
                if depth == 0 {
                    return;
                }
            } else {
                self.at += self.peek().map_or(0, char::len_utf8);
            }
        }
    }

    /// Skips an attribute such as `#![enable(..)]`.
    fn attribute(&mut self) {
        self.at += self.rest().find(']').map_or(self.rest().len(), |end| end + 1);
    }

    fn word(&mut self) -> &'a str {
        let rest = self.rest();
        let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(rest.len());
        self.at += end;
        &rest[..end]
    }

    /// Moves to the beginning of an inner value.
    fn enter(&mut self, step: Step) -> Option<usize> {
        loop {
            let name = self.word();
            self.space();
            if !['(', '[', '{'].into_iter().any(|open| self.eat(open)) {
                return None;
            }
            self.space();
            // `Some(..)` has no step of its own in a path.
            if name != "Some" {
                break;
            }
        }
        let mut number = 0;
        loop {
            self.space();
            if self.peek().is_none_or(|c| [')', ']', '}'].contains(&c)) {
                return None;
            }
            match step {
                Step::Item(wanted) if wanted == number => return Some(self.at),
                Step::Item(_) => {}
                Step::Field(wanted) => {
                    let before = self.at;
                    let name = self.word();
                    self.space();
                    if self.eat(':') {
                        self.space();
                        if name == wanted {
                            return Some(self.at);
                        }
                    } else {
                        self.at = before;
                    }
                }
            }
            self.skip();
            self.space();
            self.eat(',');
            number += 1;
        }
    }

    /// Skips a value, up to the comma or the bracket after it.
    fn skip(&mut self) {
        let mut depth = 0_usize;
        while let Some(c) = self.peek() {
            match c {
                '(' | '[' | '{' => depth += 1,
                ')' | ']' | '}' if depth == 0 => return,
                ')' | ']' | '}' => depth -= 1,
                ',' if depth == 0 => return,
                '"' => {
                    self.string();
                    continue;
                }
                '\'' => {
                    self.character();
                    continue;
                }
                'r' if self.raw_string() => continue,
                c if c.is_alphanumeric() || c == '_' => {
                    // The rest of a word cannot begin a raw string, except after the `b` of a byte
                    // string.
                    self.at += c.len_utf8();
                    if c != 'b' {
                        self.word();
                    }
                    continue;
                }
                '/' => {
                    let before = self.at;
                    self.space();
                    if self.at != before {
                        continue;
                    }
                }
                _ => {}
            }
            self.at += c.len_utf8();
        }
    }

    fn string(&mut self) {
        self.eat('"');
        while let Some(c) = self.peek() {
            self.at += c.len_utf8();
            match c {
                '"' => return,
                '\\' => self.at += self.peek().map_or(0, char::len_utf8),
                _ => {}
            }
        }
    }

    fn character(&mut self) {
        self.eat('\'');
        self.eat('\\');
        self.at += self.peek().map_or(0, char::len_utf8);
        self.at += self.rest().find('\'').map_or(self.rest().len(), |end| end + 1);
    }

    /// Skips `r"…"` or `r#"…"#`; returns false for a word that begins with `r`.
    fn raw_string(&mut self) -> bool {
        let inside = self.rest().trim_start_matches('r').trim_start_matches('#');
        let hashes = self.rest().len() - 1 - inside.len();
        let opened = format!("r{}\"", "#".repeat(hashes.min(255)));
        if hashes > 255 || !self.rest().starts_with(&opened) {
            return false;
        }
        self.at += opened.len();
        let close = format!("\"{}", "#".repeat(hashes));
        self.at += self.rest().find(&close).map_or(self.rest().len(), |end| end + close.len());
        true
    }
}

#[cfg(test)]
mod tests {
    use super::{Step::*, *};

    const TEXT: &str = r##"#![enable(implicit_some)]
// a comment with (brackets: [
Scene(
    /* and /* one */ inside ( */
    title: "a \"title\", with: (brackets",
    raw: r#"x "quoted" ] x"#, letter: '\'', bytes: b"a)b",
    bodies: [
        (name: "one"), Body(name: "zwölf", at: (1, -2.5e3, NaN)),
    ],
    network: Some(Host(guest: (link: "paper-1"))),
)"##;

    fn at(path: &[Step]) -> (usize, usize, &'static str) {
        let byte = locate(TEXT, path);
        let (line, column) = line_and_column(TEXT, byte);
        (line, column, &TEXT[byte..(byte + 6).min(TEXT.len())])
    }

    #[test]
    fn values_are_found_behind_strings_comments_and_options() {
        assert_eq!(at(&[]), (3, 1, "Scene("));
        assert_eq!(at(&[Field("title")]).0, 5);
        assert_eq!(at(&[Field("bytes")]), (6, 52, "b\"a)b\""));
        assert_eq!(at(&[Field("bodies"), Item(1), Field("name")]), (8, 35, "\"zwöl"));
        assert_eq!(at(&[Field("bodies"), Item(1), Field("at"), Item(2)]), (8, 60, "NaN)),"));
        assert_eq!(at(&[Field("network"), Field("guest"), Field("link")]), (10, 38, "\"paper"));
    }

    #[test]
    fn what_was_left_out_is_where_it_would_be() {
        assert_eq!(at(&[Field("bodies"), Item(0), Field("model")]), (8, 9, "(name:"));
        assert_eq!(at(&[Field("grabs"), Item(3)]), (3, 1, "Scene("));
    }

    #[test]
    fn a_text_that_is_none_ends_the_search() {
        for text in [
            "",
            "(",
            "(a:",
            "((((((((((",
            "\"",
            "'",
            "r#\"",
            "/*",
            "#![",
            "(a: 'x",
            "ä",
            "(r#x: r)",
            "((,,,,)",
        ] {
            for path in [&[][..], &[Field("a")], &[Item(0), Item(1)], &[Field("b"), Field("c")]] {
                assert!(locate(text, path) <= text.len());
            }
        }
        // The depth of the text does not use stack.
        let deep = "(".repeat(1_000_000);
        assert!(locate(&deep, &[Item(1)]) <= deep.len());
    }
}

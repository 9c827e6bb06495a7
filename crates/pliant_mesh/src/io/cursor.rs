//! Reads words and numbers, as text or binary, and reports the place of an error.

use std::{collections::HashMap, str::FromStr};

use crate::{MeshError, Place};

/// Encoding of the numbers in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Text,
    LittleEndian,
    BigEndian,
}

/// Read position in the bytes of a file.
pub(super) struct Cursor<'a> {
    format: &'static str,
    bytes: &'a [u8],
    at: usize,
    line: usize,
    /// Whether `#` starts a comment that runs to the end of the line.
    comments: bool,
    pub(super) encoding: Encoding,
}

impl<'a> Cursor<'a> {
    pub(super) fn new(format: &'static str, bytes: &'a [u8]) -> Self {
        Self { format, bytes, at: 0, line: 1, comments: false, encoding: Encoding::Text }
    }

    pub(super) fn with_comments(mut self) -> Self {
        self.comments = true;
        self
    }

    fn place(&self) -> Place {
        match self.encoding {
            Encoding::Text => Place::Line(self.line),
            Encoding::LittleEndian | Encoding::BigEndian => Place::Byte(self.at),
        }
    }

    pub(super) fn error(&self, expected: impl Into<String>, found: impl Into<String>) -> MeshError {
        parse_error(self.format, self.place(), expected, found)
    }

    /// Returns the number of the current line, counted from 1.
    pub(super) fn line(&self) -> usize {
        self.line
    }

    fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Reads the next word of text. Returns `None` at the end of the file.
    pub(super) fn next_word(&mut self) -> Option<String> {
        while let Some(&byte) = self.bytes.get(self.at) {
            if byte.is_ascii_whitespace() {
                self.at += 1;
                self.line += usize::from(byte == b'\n');
            } else if self.comments && byte == b'#' {
                self.next_line();
            } else {
                break;
            }
        }
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
        self.at += length;
        (length > 0).then(|| String::from_utf8_lossy(&rest[..length]).into_owned())
    }

    /// Returns the next word of text without consuming it.
    pub(super) fn peek_word(&mut self) -> Option<String> {
        let (at, line) = (self.at, self.line);
        let word = self.next_word();
        (self.at, self.line) = (at, line);
        word
    }

    /// Reads the next word of text. Returns an error at the end of the file.
    pub(super) fn word(&mut self, expected: &str) -> Result<String, MeshError> {
        self.next_word().ok_or_else(|| self.error(expected, "the end of the file"))
    }

    /// Reads one word and returns an error if it is not `keyword`.
    pub(super) fn keyword(&mut self, keyword: &str) -> Result<(), MeshError> {
        let word = self.word(keyword)?;
        if word == keyword { Ok(()) } else { Err(self.error(keyword, word)) }
    }

    /// Reads the rest of the current line without its end. Returns `None` at the end of the file.
    pub(super) fn next_line(&mut self) -> Option<String> {
        if self.remaining() == 0 {
            return None;
        }
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&b| b == b'\n').map_or(rest.len(), |n| n + 1);
        self.at += length;
        self.line += usize::from(rest[..length].ends_with(b"\n"));
        Some(String::from_utf8_lossy(&rest[..length]).trim_end_matches(['\r', '\n']).to_owned())
    }

    /// Skips everything up to and including the next occurrence of the text `end`.
    pub(super) fn skip_past(&mut self, end: &str) -> Result<(), MeshError> {
        let rest = &self.bytes[self.at..];
        match rest.windows(end.len()).position(|w| w == end.as_bytes()) {
            Some(n) => {
                self.line += rest[..n].iter().filter(|&&b| b == b'\n').count();
                self.at += n + end.len();
                Ok(())
            }
            None => Err(self.error(end, "the end of the file")),
        }
    }

    /// Reads a number that is written as a word.
    pub(super) fn parse<T: FromStr>(&mut self, expected: &str) -> Result<T, MeshError> {
        let word = self.word(expected)?;
        word.parse().map_err(|_| self.error(expected, word))
    }

    /// Reads the next `N` raw bytes.
    pub(super) fn raw<const N: usize>(&mut self, expected: &str) -> Result<[u8; N], MeshError> {
        match self.bytes[self.at..].first_chunk::<N>() {
            Some(&bytes) => {
                self.at += N;
                Ok(bytes)
            }
            None => Err(self.error(expected, "the end of the file")),
        }
    }

    /// Reads a finite floating-point number, 8 bytes when binary.
    pub(super) fn real(&mut self, expected: &str) -> Result<f64, MeshError> {
        let value = match self.encoding {
            Encoding::Text => self.parse(expected)?,
            Encoding::LittleEndian => f64::from_le_bytes(self.raw(expected)?),
            Encoding::BigEndian => f64::from_be_bytes(self.raw(expected)?),
        };
        if value.is_finite() {
            Ok(value)
        } else {
            Err(self.error(format!("a finite {expected}"), value.to_string()))
        }
    }

    /// Reads a finite floating-point number, 4 bytes when binary.
    pub(super) fn short_real(&mut self, expected: &str) -> Result<f64, MeshError> {
        let value = match self.encoding {
            Encoding::Text => return self.real(expected),
            Encoding::LittleEndian => f32::from_le_bytes(self.raw(expected)?),
            Encoding::BigEndian => f32::from_be_bytes(self.raw(expected)?),
        };
        if value.is_finite() {
            Ok(f64::from(value))
        } else {
            Err(self.error(format!("a finite {expected}"), value.to_string()))
        }
    }

    /// Reads a position, m.
    pub(super) fn point(&mut self) -> Result<[f64; 3], MeshError> {
        Ok([self.real("coordinate x")?, self.real("coordinate y")?, self.real("coordinate z")?])
    }

    /// Reads a signed integer, 4 bytes when binary.
    pub(super) fn int(&mut self, expected: &str) -> Result<i64, MeshError> {
        Ok(match self.encoding {
            Encoding::Text => self.parse(expected)?,
            Encoding::LittleEndian => i64::from(i32::from_le_bytes(self.raw(expected)?)),
            Encoding::BigEndian => i64::from(i32::from_be_bytes(self.raw(expected)?)),
        })
    }

    /// Reads an unsigned integer, 8 bytes when binary.
    pub(super) fn size(&mut self, expected: &str) -> Result<u64, MeshError> {
        Ok(match self.encoding {
            Encoding::Text => self.parse(expected)?,
            Encoding::LittleEndian => u64::from_le_bytes(self.raw(expected)?),
            Encoding::BigEndian => u64::from_be_bytes(self.raw(expected)?),
        })
    }

    /// Refuses a count of items that the rest of the file cannot hold when each takes at least
    /// `bytes_each` bytes.
    ///
    /// The caller may therefore reserve memory for an accepted count.
    pub(super) fn fits(&self, count: u64, bytes_each: usize, what: &str) -> Result<usize, MeshError> {
        let most = self.remaining() / bytes_each.max(1) + 1;
        usize::try_from(count).ok().filter(|&n| n <= most).ok_or_else(|| {
            self.error(
                format!("a number of {what} that the rest of the file can hold (at most {most})"),
                count.to_string(),
            )
        })
    }
}

/// Makes an error from the content that the format requires at a place and the content found there.
pub(super) fn parse_error(
    format: &'static str,
    place: Place,
    expected: impl Into<String>,
    found: impl Into<String>,
) -> MeshError {
    MeshError::Parse { format, place, expected: expected.into(), found: shortened(found.into()) }
}

fn shortened(text: String) -> String {
    const LONGEST: usize = 60;
    if text.chars().count() <= LONGEST {
        return text;
    }
    text.chars().take(LONGEST).chain("...".chars()).collect()
}

/// Node numbers of a file with the index of each node in the list.
pub(super) struct Tags(HashMap<u64, u32>);

impl Tags {
    pub(super) fn with_capacity(count: usize) -> Self {
        Self(HashMap::with_capacity(count))
    }

    /// Records that the node `tag` has the index `index`.
    pub(super) fn insert(&mut self, cursor: &Cursor<'_>, tag: u64, index: usize) -> Result<(), MeshError> {
        match self.0.insert(tag, index as u32) {
            None => Ok(()),
            Some(_) => Err(cursor.error("node numbers that differ", format!("node {tag} twice"))),
        }
    }

    pub(super) fn index(&self, cursor: &Cursor<'_>, tag: u64) -> Result<u32, MeshError> {
        self.0.get(&tag).copied().ok_or_else(|| {
            cursor.error(format!("the number of one of the {} nodes", self.0.len()), tag.to_string())
        })
    }
}

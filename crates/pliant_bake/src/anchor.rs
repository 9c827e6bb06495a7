//! Anchors: half-spaces such as `x<0.01` that fix a part of a body.

use std::fmt;
use std::str::FromStr;

/// Comparison between a coordinate and the bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// The coordinate is less than the bound (`<`).
    Less,
    /// The coordinate is at most the bound (`<=`).
    LessOrEqual,
    /// The coordinate is greater than the bound (`>`).
    Greater,
    /// The coordinate is at least the bound (`>=`).
    GreaterOrEqual,
}

/// Half-space that fixes all nodes whose coordinate along `axis` satisfies the comparison.
///
/// Several anchors together fix the union of their nodes.
///
/// ```
/// let anchor: pliant_bake::Anchor = "x<0.01".parse()?;
/// assert!(anchor.holds([0.0, 5.0, 5.0]) && !anchor.holds([0.01, 0.0, 0.0]));
/// # Ok::<(), pliant_bake::AnchorSyntax>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anchor {
    /// Axis of the coordinate: 0, 1 or 2 for x, y or z.
    pub axis: usize,
    /// Comparison of the coordinate with `bound`.
    pub comparison: Comparison,
    /// Bound of the half-space, m.
    pub bound: f64,
}

impl Anchor {
    /// Returns whether the point (m) lies in the half-space.
    #[must_use]
    pub fn holds(&self, point: [f64; 3]) -> bool {
        let x = point[self.axis.min(2)];
        match self.comparison {
            Comparison::Less => x < self.bound,
            Comparison::LessOrEqual => x <= self.bound,
            Comparison::Greater => x > self.bound,
            Comparison::GreaterOrEqual => x >= self.bound,
        }
    }
}

impl fmt::Display for Anchor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = match self.comparison {
            Comparison::Less => "<",
            Comparison::LessOrEqual => "<=",
            Comparison::Greater => ">",
            Comparison::GreaterOrEqual => ">=",
        };
        write!(f, "{}{sign}{}", ["x", "y", "z"][self.axis.min(2)], self.bound)
    }
}

/// Error for a text that is not an anchor.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "anchor `{text}`: expected an axis, a comparison and a finite number of meters, such as `x<0.01`; {problem}"
)]
pub struct AnchorSyntax {
    /// Received text.
    pub text: String,
    /// Description of the problem.
    pub problem: String,
}

impl FromStr for Anchor {
    type Err = AnchorSyntax;

    /// Parses `AXIS COMPARISON NUMBER`, for example `x<0.01`. Spaces are allowed.
    ///
    /// The axis is x, y or z, the comparison is `<`, `<=`, `>` or `>=`, and the number is in
    /// meters.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = |problem: String| AnchorSyntax { text: text.to_owned(), problem };
        let trimmed = text.trim();
        let axis = match trimmed.chars().next() {
            Some('x' | 'X') => 0,
            Some('y' | 'Y') => 1,
            Some('z' | 'Z') => 2,
            Some(other) => return Err(wrong(format!("`{other}` is no axis"))),
            None => return Err(wrong("it is empty".to_owned())),
        };
        let rest = trimmed[1..].trim_start();
        let (comparison, number) = if let Some(number) = rest.strip_prefix("<=") {
            (Comparison::LessOrEqual, number)
        } else if let Some(number) = rest.strip_prefix(">=") {
            (Comparison::GreaterOrEqual, number)
        } else if let Some(number) = rest.strip_prefix('<') {
            (Comparison::Less, number)
        } else if let Some(number) = rest.strip_prefix('>') {
            (Comparison::Greater, number)
        } else {
            return Err(wrong("no comparison (<, <=, >, >=) follows the axis".to_owned()));
        };
        match number.trim().parse::<f64>() {
            Ok(bound) if bound.is_finite() => Ok(Self { axis, comparison, bound }),
            _ => Err(wrong(format!("`{}` is no finite number", number.trim()))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_it_writes() {
        for text in ["x<0.01", "y<=-0.5", "z>1", "x>=0"] {
            let anchor: Anchor = text.parse().unwrap();
            assert_eq!(anchor.to_string(), text);
        }
        let spaced: Anchor = " y <= 1e-3 ".parse().unwrap();
        assert_eq!(spaced, Anchor { axis: 1, comparison: Comparison::LessOrEqual, bound: 1e-3 });
        assert!(spaced.holds([9.0, 1e-3, 9.0]) && !spaced.holds([0.0, 1.1e-3, 0.0]));
    }

    #[test]
    fn refuses_what_is_no_half_space() {
        for text in ["", "w<1", "x", "x=1", "x<", "x<nan", "x<inf", "x<1m", "<1", "x<1<2", "ä<1"] {
            let error = text.parse::<Anchor>().unwrap_err().to_string();
            assert!(error.contains("such as `x<0.01`"), "{text}: {error}");
        }
    }
}

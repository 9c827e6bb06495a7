//! Arguments that commands share.

/// Parses three numbers separated by commas.
pub(crate) fn three<T: std::str::FromStr>(text: &str) -> Result<[T; 3], String> {
    let parts: Vec<T> = text
        .split(',')
        .map(|part| part.trim().parse().map_err(|_| format!("`{part}` is no such number")))
        .collect::<Result<_, _>>()?;
    parts.try_into().map_err(|parts: Vec<T>| {
        format!("expected three numbers with commas between them, got {}", parts.len())
    })
}

//! Arguments that commands share.

use pliant_modal::Elasticity;

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

/// Parses the name of an elasticity.
pub(crate) fn elasticity(text: &str) -> Result<Elasticity, String> {
    match text {
        "linear" => Ok(Elasticity::Linear),
        "reduced" => Ok(Elasticity::Reduced),
        _ => Err("expected linear or reduced".to_owned()),
    }
}

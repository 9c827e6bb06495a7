//! Finds the anchored nodes and checks that the anchors fix neither too little nor too much.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use crate::fem::{FeMesh, Lists};
use crate::{BakeConfig, BakeError, Paint, region};

/// Stands among the texts of a model's anchors for a painting.
const PAINTED: &str = "painted";

/// Distance from a line, as a fraction of the body's size, below which anchored nodes count as
/// lying on the line.
const THIN: f64 = 1e-6;

/// Returns for each node whether an anchor or the painting fixes it. All entries are false for a
/// free body.
pub(crate) fn anchored_nodes(fe: &FeMesh, config: &BakeConfig) -> Result<Vec<bool>, BakeError> {
    let mut held = match &config.paint {
        Some(paint) => region::painted_nodes(fe, paint)?,
        None => vec![false; fe.nodes.len()],
    };
    for anchor in &config.anchors {
        let mut any = false;
        for (held, &p) in held.iter_mut().zip(&fe.nodes) {
            if anchor.holds(p) {
                *held = true;
                any = true;
            }
        }
        if !any {
            let along = fe.nodes.iter().map(|p| p[anchor.axis.min(2)]);
            return Err(BakeError::AnchorHoldsNothing {
                anchor: anchor.to_string(),
                low: along.clone().fold(f64::INFINITY, f64::min),
                high: along.fold(f64::NEG_INFINITY, f64::max),
            });
        }
    }
    if held.iter().all(|&held| held) {
        return Err(BakeError::AnchorHoldsEverything { anchors: quoted(config), nodes: held.len() });
    }
    Ok(held)
}

/// Checks that every connected part is fixed by nodes that are not all on one line. A free body
/// must be a single part.
pub(crate) fn check_connected(
    fe: &FeMesh,
    graph: &Lists,
    held: &[bool],
    config: &BakeConfig,
) -> Result<(), BakeError> {
    let parts = connected_parts(graph);
    if config.is_free() {
        return match parts.get(1) {
            None => Ok(()),
            Some(part) => Err(loose(fe, part, parts.len())),
        };
    }
    let size = {
        let mut extent: f64 = 0.0;
        for k in 0..3 {
            let along = fe.nodes.iter().map(|p| p[k]);
            extent = extent
                .max(along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min));
        }
        extent
    };
    for part in &parts {
        let nodes: Vec<Vector3<f64>> = part
            .iter()
            .filter(|&&n| held[n as usize])
            .map(|&n| Vector3::from(fe.nodes[n as usize]))
            .collect();
        if nodes.is_empty() {
            return Err(loose(fe, part, parts.len()));
        }
        let mean = nodes.iter().sum::<Vector3<f64>>() / nodes.len() as f64;
        let spread: Matrix3<f64> = nodes.iter().map(|p| (p - mean) * (p - mean).transpose()).sum();
        let mut moments: Vec<f64> = SymmetricEigen::new(spread).eigenvalues.iter().copied().collect();
        moments.sort_by(f64::total_cmp);
        if moments[1] <= (THIN * size).powi(2) {
            return Err(BakeError::AnchorTooThin {
                anchors: quoted(config),
                nodes: nodes.len(),
                at: mean.into(),
            });
        }
    }
    Ok(())
}

fn quoted(config: &BakeConfig) -> String {
    names(config).iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

/// Returns the texts of the anchors, and [`PAINTED`] if the painting fixes something.
pub(crate) fn names(config: &BakeConfig) -> Vec<String> {
    let painted = config.paint.as_ref().is_some_and(Paint::anchors).then(|| PAINTED.to_owned());
    config.anchors.iter().map(ToString::to_string).chain(painted).collect()
}

fn loose(fe: &FeMesh, part: &[u32], parts: usize) -> BakeError {
    BakeError::LooseParts { parts, at: fe.nodes[part[0] as usize], nodes: part.len() }
}

/// Returns the nodes of each connected part, with the largest part first.
fn connected_parts(graph: &Lists) -> Vec<Vec<u32>> {
    let mut seen = vec![false; graph.len()];
    let mut parts = Vec::new();
    for start in 0..graph.len() {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        let mut part = vec![start as u32];
        let mut head = 0;
        while head < part.len() {
            for &next in graph.of(part[head] as usize) {
                if !std::mem::replace(&mut seen[next as usize], true) {
                    part.push(next);
                }
            }
            head += 1;
        }
        parts.push(part);
    }
    parts.sort_by_key(|part| std::cmp::Reverse(part.len()));
    parts
}

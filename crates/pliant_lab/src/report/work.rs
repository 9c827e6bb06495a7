//! Shared parts of the figures: timings, bodies and errors.

use std::{sync::Arc, time::Instant};

use pliant_bake::{Anchor, BakeConfig, Comparison, bake};
use pliant_mesh::TetMesh;
use pliant_modal::{Damping, Element, ModalModel};

use crate::{LabError, machine::Pinned};

/// Median and 99th percentile of the time of `work` on one core after a warm-up, us.
pub(super) fn time_us(
    repeats: usize,
    mut work: impl FnMut() -> Result<(), LabError>,
) -> Result<[f64; 2], LabError> {
    let _pinned = Pinned::new();
    for _ in 0..repeats / 10 + 1 {
        work()?;
    }
    let mut samples = Vec::with_capacity(repeats);
    for _ in 0..repeats.max(1) {
        let began = Instant::now();
        work()?;
        samples.push(began.elapsed().as_secs_f64() * 1e6);
    }
    samples.sort_by(f64::total_cmp);
    Ok([samples[samples.len() / 2], samples[(samples.len() - 1) * 99 / 100]])
}

/// An anchor where `axis` is below `bound`.
pub(super) fn anchor(axis: usize, bound: f64) -> Anchor {
    Anchor { axis, comparison: Comparison::Less, bound }
}

pub(super) fn config(element: Element, modes: usize, anchors: Vec<Anchor>) -> BakeConfig {
    BakeConfig {
        element,
        modes,
        poisson: 0.3,
        damping: Damping::Ratio(0.05),
        anchors,
        sites: Some(64),
        ..BakeConfig::linear()
    }
}

/// The model, and the time of its bake, s.
pub(super) fn baked(mesh: &TetMesh, config: &BakeConfig) -> Result<(Arc<ModalModel>, f64), LabError> {
    let made = bake(mesh, None, config, &mut |_, _| ())?;
    Ok((Arc::new(made.model), made.times.total))
}

/// The surface vertex that lies farthest along a direction.
pub(super) fn farthest(model: &ModalModel, along: [f32; 3]) -> u32 {
    let positions = model.surface().positions();
    let reach = |v: u32| (0..3).map(|k| positions[v as usize][k] * along[k]).sum::<f32>();
    (0..positions.len() as u32).max_by(|a, b| reach(*a).total_cmp(&reach(*b))).unwrap_or(0)
}

/// Root mean square and largest distance between two shapes, m.
pub(super) fn apart(a: &[[f64; 3]], b: &[[f64; 3]]) -> [f64; 2] {
    let (mut sum, mut most) = (0.0, 0.0f64);
    for (a, b) in a.iter().zip(b) {
        let d: f64 = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
        sum += d;
        most = most.max(d);
    }
    [(sum / a.len().max(1) as f64).sqrt(), most.sqrt()]
}

/// The mass-weighted difference of two motions at each sample, and its root mean square over all
/// samples. Both are relative to the root mean square of `want`.
///
/// The modes are orthonormal by mass, so `|q_a - q_b|^2 / mass` is the mean square distance over
/// the whole body. A coordinate that only one motion has counts as 0 in the other.
pub(super) fn by_mass(got: &[Vec<f64>], want: &[Vec<f64>]) -> (Vec<f64>, f64) {
    let at = |q: &[f64], k: usize| q.get(k).copied().unwrap_or(0.0);
    let square = |a: &[f64], b: &[f64]| -> f64 {
        (0..a.len().max(b.len())).map(|k| (at(a, k) - at(b, k)).powi(2)).sum()
    };
    let count = want.len().max(1) as f64;
    let size = (want.iter().map(|q| square(q, &[])).sum::<f64>() / count).sqrt().max(f64::MIN_POSITIVE);
    let off: Vec<f64> = got.iter().zip(want).map(|(a, b)| square(a, b).sqrt() / size).collect();
    let all = (off.iter().map(|e| e * e).sum::<f64>() / count).sqrt();
    (off, all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mass_weighted_error_is_a_share_of_the_motion() {
        let want = vec![vec![3.0, 4.0], vec![0.0, 5.0]];
        assert_eq!(by_mass(&want, &want), (vec![0.0, 0.0], 0.0));
        // Without the second mode the first sample misses 4 of 5, and the second sample misses
        // everything.
        let (off, all) = by_mass(&[vec![3.0], vec![0.0]], &want);
        assert!((off[0] - 0.8).abs() < 1e-12 && (off[1] - 1.0).abs() < 1e-12, "{off:?}");
        assert!((all - (0.5f64 * (0.64 + 1.0)).sqrt()).abs() < 1e-12, "{all}");
    }
}

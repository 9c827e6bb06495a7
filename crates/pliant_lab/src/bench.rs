//! Cost of a body on this machine, next to the memory bandwidth limit measured in the same run.

use std::{hint::black_box, sync::Arc, time::Instant};

use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch, Precision, streaming_sum};
use serde::Serialize;

use crate::{LabError, machine::Pinned};

/// Percentiles of a time on one core, us.
#[derive(Serialize, Debug, Clone, Copy)]
pub struct Percentiles {
    /// The median.
    pub p50: f64,
    /// The 99th percentile.
    pub p99: f64,
    /// The 99.9th percentile.
    pub p999: f64,
}

/// Cost of a body.
#[derive(Serialize, Debug, Clone)]
pub struct Cost {
    /// Number of elastic modes.
    pub modes: usize,
    /// Number of surface vertices.
    pub surface_vertices: usize,
    /// Time of a step with one grab that pulls.
    pub step_us: Percentiles,
    /// Time of a reconstruction of the whole surface.
    pub reconstruct_us: Percentiles,
    /// Time of a frame: a step with a moving hand, then the reconstruction of the resulting
    /// surface.
    pub frame_us: Percentiles,
    /// Bytes read and written by one reconstruction.
    pub bytes: usize,
    /// Bandwidth of the median reconstruction, GB/s. The reconstruction runs as in a frame: after a
    /// step, with a new shape each time.
    pub bandwidth_gb_s: f64,
    /// Bandwidth of the fastest pass over as many bytes in the same run, GB/s. The passes are plain
    /// sums in the CPU's widest registers, and reconstructions.
    pub bandwidth_limit_gb_s: f64,
}

/// Times a body on one core: steps for `seconds`, then frames for twice as long.
///
/// # Errors
/// Returns [`LabError::Model`] or [`LabError::Step`] when the body cannot be grabbed or stepped.
pub fn measure(model: Arc<ModalModel>, seconds: f64, precision: Precision) -> Result<Cost, LabError> {
    let _pinned = Pinned::new();
    let mut body = Body::new(model.clone(), BodyConfig { precision, ..BodyConfig::default() })?;
    // The hand pulls where the first mode moves most, so that the body gives way.
    let moves = |v: u32| (0..3).map(|axis| model.displacement_row(v, axis, 0).powi(2)).sum::<f32>();
    let count = model.surface().positions().len() as u32;
    let vertex = (0..count).max_by(|&a, &b| moves(a).total_cmp(&moves(b))).unwrap_or(0);
    let patch = Patch::around(model.surface(), vertex, 0.06 * model.size())?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let start = body.grab_position(grab)?;
    let mut tick = 0u32;
    let mut failed = None;
    let mut pull = |body: &mut Body| {
        tick += 1;
        let away = 0.05 * model.size() * (0.05 * f64::from(tick)).sin();
        let moved = body.set_target(grab, [start[0] + away, start[1] + 0.5 * away, start[2]]);
        if let Err(error) = moved.and_then(|()| body.step().map(|_| ())) {
            failed.get_or_insert(error);
        }
    };
    let step_us = time(seconds, || pull(&mut body));
    let mut positions = model.surface().positions().to_vec();
    let bytes = model.basis_in(precision).traffic_bytes(model.mode_count());
    let buffer = vec![1.0f32; bytes / 4];
    let mut broken = None;
    let [of_frame, of_surface, of_sum] = by_turns(
        seconds,
        &mut body,
        &mut pull,
        |body| {
            if let Err(error) = body.reconstruct(black_box(&mut positions)) {
                broken.get_or_insert(error);
            }
        },
        || {
            black_box(streaming_sum(black_box(&buffer)));
        },
    );
    if let Some(error) = failed.or(broken) {
        return Err(error.into());
    }
    // A reconstruction can read memory faster than the sum does (as on the armadillo), so the limit
    // is the fastest pass of either kind.
    let fastest = of_sum.iter().chain(&of_surface).copied().fold(f64::INFINITY, f64::min);
    let (frame_us, reconstruct_us) = (percentiles(of_frame), percentiles(of_surface));
    // Bytes per microsecond are megabytes per second.
    let gb_s = |us: f64| bytes as f64 / us.max(1e-9) * 1e-3;
    Ok(Cost {
        modes: model.mode_count(),
        surface_vertices: count as usize,
        bandwidth_gb_s: gb_s(reconstruct_us.p50),
        bandwidth_limit_gb_s: gb_s(fastest),
        step_us,
        reconstruct_us,
        frame_us,
        bytes,
    })
}

fn time(seconds: f64, mut work: impl FnMut()) -> Percentiles {
    for _ in 0..50 {
        work();
    }
    let mut samples = Vec::new();
    let begun = Instant::now();
    while samples.len() < 1_000 || (begun.elapsed().as_secs_f64() < seconds && samples.len() < 1_000_000) {
        samples.push(once(&mut work));
    }
    percentiles(samples)
}

/// Times frames (a step, then the surface) in turns of sixteen with plain sums, so that other load
/// on the machine slows both alike. The first frame of each turn is not counted, because the caches
/// still hold the data of the sums. Returns the times of whole frames, of their surfaces and of the
/// sums, us.
fn by_turns<T>(
    seconds: f64,
    body: &mut T,
    mut step: impl FnMut(&mut T),
    mut surface: impl FnMut(&mut T),
    mut sum: impl FnMut(),
) -> [Vec<f64>; 3] {
    let mut samples = [Vec::new(), Vec::new(), Vec::new()];
    let begun = Instant::now();
    while samples[0].len() < 1_000
        || (begun.elapsed().as_secs_f64() < 2.0 * seconds && samples[0].len() < 1_000_000)
    {
        for turn in 0..16 {
            let start = Instant::now();
            step(body);
            let stepped = Instant::now();
            surface(body);
            let done = Instant::now();
            if turn > 0 {
                samples[0].push((done - start).as_secs_f64() * 1e6);
                samples[1].push((done - stepped).as_secs_f64() * 1e6);
            }
        }
        sum();
        samples[2].extend((0..15).map(|_| once(&mut sum)));
    }
    samples
}

/// Time of one call, us.
fn once(work: &mut impl FnMut()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64() * 1e6
}

/// Percentiles of some times. Without any time they are zero.
pub(crate) fn percentiles(mut samples: Vec<f64>) -> Percentiles {
    samples.sort_by(f64::total_cmp);
    let last = samples.len().saturating_sub(1) as f64;
    let at = |part: f64| samples.get((last * part) as usize).copied().unwrap_or(0.0);
    Percentiles { p50: at(0.5), p99: at(0.99), p999: at(0.999) }
}

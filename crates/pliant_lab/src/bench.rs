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
    let begun = Instant::now();
    let clock = || begun.elapsed().as_secs_f64() * 1e6;
    let times = by_turns(
        2.0 * seconds,
        clock,
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
    Ok(times.cost(model.mode_count(), count as usize, bytes, step_us))
}

fn time(seconds: f64, mut work: impl FnMut()) -> Percentiles {
    for _ in 0..50 {
        work();
    }
    let mut samples = Vec::new();
    let begun = Instant::now();
    while samples.len() < 1_000 || (begun.elapsed().as_secs_f64() < seconds && samples.len() < 1_000_000) {
        let start = Instant::now();
        work();
        samples.push(start.elapsed().as_secs_f64() * 1e6);
    }
    percentiles(samples)
}

/// Times of passes in one run, us.
#[derive(Default)]
struct Turns {
    /// Whole frames: a step, then the surface.
    frames: Vec<f64>,
    /// The surfaces of the frames.
    surfaces: Vec<f64>,
    /// Plain sums of as many bytes as a surface reads and writes.
    sums: Vec<f64>,
}

impl Turns {
    /// The cost of a body whose surface reads and writes `bytes` bytes.
    fn cost(self, modes: usize, surface_vertices: usize, bytes: usize, step_us: Percentiles) -> Cost {
        // A reconstruction can read memory faster than the sum does (as on the armadillo), so the
        // limit is the fastest pass of either kind.
        let fastest = self.sums.iter().chain(&self.surfaces).copied().fold(f64::INFINITY, f64::min);
        let (frame_us, reconstruct_us) = (percentiles(self.frames), percentiles(self.surfaces));
        // Bytes per microsecond are megabytes per second.
        let gb_s = |us: f64| bytes as f64 / us.max(1e-9) * 1e-3;
        Cost {
            modes,
            surface_vertices,
            bandwidth_gb_s: gb_s(reconstruct_us.p50),
            bandwidth_limit_gb_s: gb_s(fastest),
            step_us,
            reconstruct_us,
            frame_us,
            bytes,
        }
    }
}

/// Times frames (a step, then the surface) in turns of sixteen with plain sums, so that other load
/// on the machine slows both alike. The first frame of each turn is not counted, because the caches
/// still hold the data of the sums. It runs for `seconds`, and a thousand frames at least. `clock`
/// tells the time in us.
fn by_turns<T>(
    seconds: f64,
    mut clock: impl FnMut() -> f64,
    body: &mut T,
    mut step: impl FnMut(&mut T),
    mut surface: impl FnMut(&mut T),
    mut sum: impl FnMut(),
) -> Turns {
    let mut times = Turns::default();
    let begun = clock();
    while times.frames.len() < 1_000 || (clock() - begun < seconds * 1e6 && times.frames.len() < 1_000_000) {
        for turn in 0..16 {
            let start = clock();
            step(body);
            let stepped = clock();
            surface(body);
            let done = clock();
            if turn > 0 {
                times.frames.push(done - start);
                times.surfaces.push(done - stepped);
            }
        }
        sum();
        for _ in 0..15 {
            let start = clock();
            sum();
            times.sums.push(clock() - start);
        }
    }
    times
}

/// Percentiles of some times. Without any time they are zero.
pub(crate) fn percentiles(mut samples: Vec<f64>) -> Percentiles {
    samples.sort_by(f64::total_cmp);
    let last = samples.len().saturating_sub(1) as f64;
    let at = |part: f64| samples.get((last * part) as usize).copied().unwrap_or(0.0);
    Percentiles { p50: at(0.5), p99: at(0.99), p999: at(0.999) }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    /// A body whose step takes 3 us, whose surface takes 5 us and whose sum takes 4 us. The first
    /// pass after one of another kind takes a hundred times as long, since the caches have to fill.
    fn turns(seconds: f64, surface_us: f64) -> Turns {
        let (now, last) = (Cell::new(0.0), Cell::new(' '));
        let pass = |kind: char, us: f64| {
            let cold = last.replace(kind) != kind;
            now.set(now.get() + if cold { 100.0 * us } else { us });
        };
        by_turns(
            seconds,
            || now.get(),
            &mut (),
            |()| pass('f', 3.0),
            |()| pass('f', surface_us),
            || pass('s', 4.0),
        )
    }

    #[test]
    fn a_frame_is_a_step_and_its_surface_and_warm_ones_count() {
        let times = turns(0.0, 5.0);
        assert_eq!(times.frames.len(), 1_005, "15 of 16 in each turn, and a thousand at least");
        assert_eq!((times.surfaces.len(), times.sums.len()), (1_005, 1_005));
        assert!(times.frames.iter().all(|&us| us == 8.0), "{:?}", times.frames);
        assert!(times.surfaces.iter().all(|&us| us == 5.0), "{:?}", times.surfaces);
        assert!(times.sums.iter().all(|&us| us == 4.0), "{:?}", times.sums);
        // A turn takes 16 frames and 16 sums and what is cold: 8 * 16 + 297 and 4 * 16 + 396 us.
        let longer = turns(0.885, 5.0);
        assert_eq!(longer.frames.len(), 15 * 1_000);
    }

    #[test]
    fn the_limit_is_the_fastest_pass_of_either_kind() {
        let cost = |surface_us, spread: [f64; 2]| {
            let mut times = turns(0.0, surface_us);
            times.sums[7] = spread[0];
            times.surfaces[7] = spread[1];
            times.cost(12, 100, 8_000, percentiles(vec![3.0]))
        };
        // 8,000 bytes in 5 us are 1.6 GB/s, in 4 us 2 GB/s.
        let slower = cost(5.0, [4.0, 5.0]);
        assert_eq!((slower.bandwidth_gb_s, slower.bandwidth_limit_gb_s), (1.6, 2.0));
        // The fastest one counts, and for the surface itself the median.
        let once = cost(5.0, [2.0, 5.0]);
        assert_eq!((once.bandwidth_gb_s, once.bandwidth_limit_gb_s), (1.6, 4.0));
        let faster = cost(2.5, [4.0, 2.0]);
        assert_eq!((faster.bandwidth_gb_s, faster.bandwidth_limit_gb_s), (3.2, 4.0));
        assert_eq!((faster.frame_us.p50, faster.reconstruct_us.p50, faster.step_us.p50), (5.5, 2.5, 3.0));
    }
}

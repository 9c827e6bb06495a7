//! Order of accuracy of the reaction, compared with the modal equations integrated in very small
//! steps.

use crate::rod;

use std::sync::Arc;

use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch, StepSettings, warp};
use rod::{rod, tip};

const MODES: usize = 8;
/// Durations of the hand's motion and of the whole run, s.
const MOVES: f64 = 0.5;
const WATCHED: f64 = 1.0;

/// Displacement of the hand, m, smooth up to its third derivative.
fn way(t: f64) -> f64 {
    let x = (t / MOVES).clamp(0.0, 1.0);
    0.05 * x.powi(4) * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))
}

fn patch(model: &ModalModel) -> Patch {
    Patch::around(model.surface(), tip(), 0.1).unwrap()
}

/// Returns the reaction along the rod at the end of each step, N.
fn reactions(model: &Arc<ModalModel>, hz: f64, second_order: bool) -> Vec<f64> {
    let config = BodyConfig {
        step: 1.0 / hz,
        settings: StepSettings { second_order, warp: false, ..Default::default() },
        ..Default::default()
    };
    let mut body = Body::new(model.clone(), config).unwrap();
    let grab = body.grab(&patch(model), GrabConfig::default()).unwrap();
    let [x, y, z] = body.target(grab).unwrap();
    (1..=(WATCHED * hz) as usize)
        .map(|step| {
            body.set_target(grab, [x + way(step as f64 / hz), y, z]).unwrap();
            body.step().unwrap();
            body.reaction(grab).unwrap()[0]
        })
        .collect()
}

/// Integrates `modes` coordinates and their velocities from rest by the Runge-Kutta method in steps
/// of 1/`fine` s. Samples the coordinates at multiples of 1/`hz` s.
fn integrate<T>(
    modes: usize,
    [hz, fine]: [f64; 2],
    slope: impl Fn(&[f64], f64) -> Vec<f64>,
    sample: impl Fn(&[f64], f64) -> T,
) -> Vec<T> {
    let add =
        |s: &[f64], k: &[f64], h: f64| -> Vec<f64> { s.iter().zip(k).map(|(s, k)| s + h * k).collect() };
    let (h, every) = (1.0 / fine, (fine / hz) as usize);
    let mut state = vec![0.0; 2 * modes];
    let mut out = Vec::new();
    for step in 0..(WATCHED * fine) as usize {
        let t = step as f64 * h;
        let k1 = slope(&state, t);
        let k2 = slope(&add(&state, &k1, 0.5 * h), t + 0.5 * h);
        let k3 = slope(&add(&state, &k2, 0.5 * h), t + 0.5 * h);
        let k4 = slope(&add(&state, &k3, h), t + h);
        for (i, s) in state.iter_mut().enumerate() {
            *s += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        if (step + 1) % every == 0 {
            out.push(sample(&state[..modes], t + h));
        }
    }
    out
}

/// Returns the same reaction from `q'' + c q' + omega^2 q = phi (target - phi . q) / C`.
///
/// See [`integrate`] for `hz` and `fine`.
fn exact(model: &Arc<ModalModel>, hz: f64, fine: f64) -> Vec<f64> {
    let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
    let patch = patch(model);
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let compliance = body.compliance(grab).unwrap()[0][0];
    let phi: Vec<f64> = (0..MODES)
        .map(|mode| {
            let row = |&(v, w): &(u32, f64)| w * f64::from(model.displacement_row(v, 0, mode));
            patch.entries().iter().map(row).sum()
        })
        .collect();
    let pull =
        |q: &[f64], t: f64| (way(t) - phi.iter().zip(q).map(|(phi, q)| phi * q).sum::<f64>()) / compliance;
    let slope = |state: &[f64], t: f64| -> Vec<f64> {
        let (q, v) = state.split_at(MODES);
        let pull = pull(q, t);
        let a =
            (0..MODES).map(|k| phi[k] * pull - model.damping()[k] * v[k] - model.omega()[k].powi(2) * q[k]);
        v.iter().copied().chain(a).collect()
    };
    integrate(MODES, [hz, fine], slope, |q, t| -pull(q, t))
}

/// Returns the largest and the root mean square difference, as shares of the largest force.
fn error(reactions: &[f64], exact: &[f64]) -> (f64, f64) {
    let peak = exact.iter().fold(0.0f64, |peak, f| peak.max(f.abs()));
    let off = || reactions.iter().zip(exact).map(|(a, b)| (a - b) / peak);
    (off().fold(0.0, |m, x| m.max(x.abs())), (off().map(|x| x * x).sum::<f64>() / exact.len() as f64).sqrt())
}

#[test]
fn what_a_hand_feels_is_of_second_order() {
    let model = Arc::new(rod(2e5, MODES, 0.05, false));
    let of = |hz: f64, second| error(&reactions(&model, hz, second), &exact(&model, hz, 192_000.0));
    // The largest errors of the second order, as shares of the largest force.
    for (hz, most) in [(60.0, 3e-3), (120.0, 7.5e-4), (240.0, 2e-4), (480.0, 6e-5)] {
        let (first, second) = (of(hz, false), of(hz, true));
        println!(
            "{hz} Hz: first order {:.2} % (rms {:.2} %), second {:.3} % (rms {:.3} %)",
            100.0 * first.0,
            100.0 * first.1,
            100.0 * second.0,
            100.0 * second.1
        );
        assert!(second.0 < most && second.0 < 0.1 * first.0, "{hz} Hz: {first:?}, {second:?}");
    }
    let errors: Vec<f64> = [120.0, 240.0, 480.0].map(|hz| of(hz, true).1).to_vec();
    for pair in errors.windows(2) {
        assert!(pair[0] / pair[1] > 3.3, "half the step, a quarter of the error: {errors:?}");
    }
}

/// The hand's own spring, N/m. With a stiffer one the fastest modes under the hand are still too
/// fast for these steps, and the error falls unevenly.
const SOFT: GrabConfig = GrabConfig { stiffness: Some(100.0), relaxation: 0.0 };

/// A hand that bends a warped body far: the patch, and the six numbers on which its displacement
/// depends, as rows over the modes.
struct Bent {
    model: Arc<ModalModel>,
    patch: Patch,
    rows: [Vec<f64>; 6],
    way: [f64; 3],
}

impl Bent {
    fn new() -> Self {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
        let model = Arc::new(ModalModel::read(path).unwrap());
        let positions = model.surface().positions();
        let vertex =
            (0..positions.len()).max_by(|&a, &b| positions[a][0].total_cmp(&positions[b][0])).unwrap() as u32;
        let size = model.size();
        let patch = Patch::around(model.surface(), vertex, 0.08 * size).unwrap();
        let rows = std::array::from_fn(|row| {
            let of = |vertex, mode| match row {
                0..3 => model.displacement_row(vertex, row, mode),
                _ => model.rotation_row(vertex, row - 3, mode),
            };
            let mean = |mode| patch.entries().iter().map(|&(v, w)| w * f64::from(of(v, mode))).sum();
            (0..model.mode_count()).map(mean).collect()
        });
        Self { model, patch, rows, way: [0.15 * size, 0.2 * size, 0.1 * size] }
    }

    fn target(&self, t: f64) -> [f64; 3] {
        self.way.map(|reach| reach * way(t) / way(MOVES))
    }

    fn reactions(&self, hz: f64) -> Vec<[f64; 3]> {
        let config = BodyConfig { step: 1.0 / hz, ..Default::default() };
        let mut body = Body::new(self.model.clone(), config).unwrap();
        let grab = body.grab(&self.patch, SOFT).unwrap();
        let start = body.target(grab).unwrap();
        let at = |t: f64| std::array::from_fn(|k| start[k] + self.target(t)[k]);
        (1..=(WATCHED * hz) as usize)
            .map(|step| {
                body.set_target(grab, at(step as f64 / hz)).unwrap();
                body.step().unwrap();
                body.reaction(grab).unwrap()
            })
            .collect()
    }

    /// The reaction by the Runge-Kutta method, as in [`exact`], with the derivative of the warped
    /// displacement by central differences.
    fn exact(&self, hz: f64, fine: f64) -> Vec<[f64; 3]> {
        use nalgebra::{Matrix3, Vector3};
        let mut body = Body::new(self.model.clone(), BodyConfig::default()).unwrap();
        let grab = body.grab(&self.patch, SOFT).unwrap();
        let compliance = body.compliance(grab).unwrap();
        let stiffness = Matrix3::from_fn(|i, j| compliance[i][j]).try_inverse().unwrap();
        let modes = self.model.mode_count();
        let six = |q: &[f64]| {
            self.rows.each_ref().map(|row| row.iter().zip(q).map(|(row, q)| row * q).sum::<f64>())
        };
        let place = |[a, b, c, x, y, z]: [f64; 6]| Vector3::from(warp([x, y, z], [a, b, c]));
        let pull = |q: &[f64], t: f64| stiffness * (Vector3::from(self.target(t)) - place(six(q)));
        let slope = |state: &[f64], t: f64| -> Vec<f64> {
            let (q, v) = state.split_at(modes);
            let (pull, at) = (pull(q, t), six(q));
            let forces: [f64; 6] = std::array::from_fn(|k| {
                let moved = |by: f64| {
                    let mut at = at;
                    at[k] += by;
                    place(at)
                };
                (moved(1e-5) - moved(-1e-5)).dot(&pull) / 2e-5
            });
            let a = (0..modes).map(|k| {
                let held: f64 = self.rows.iter().zip(forces).map(|(row, force)| row[k] * force).sum();
                held - self.model.damping()[k] * v[k] - self.model.omega()[k].powi(2) * q[k]
            });
            v.iter().copied().chain(a).collect()
        };
        integrate(modes, [hz, fine], slope, |q, t| (-pull(q, t)).into())
    }
}

#[test]
fn what_a_hand_feels_of_a_bent_body_comes_nearer_with_the_step() {
    let bent = Bent::new();
    // The reference at the highest rate contains those at the others.
    let exact = bent.exact(960.0, 19_200.0);
    let peak = exact.iter().flatten().fold(0.0f64, |peak, f| peak.max(f.abs()));
    let errors = [240.0, 480.0, 960.0].map(|hz| {
        let reactions = bent.reactions(hz);
        let every = (960.0 / hz) as usize;
        let right = exact.iter().skip(every - 1).step_by(every);
        let off = reactions.iter().zip(right).flat_map(|(a, b)| (0..3).map(move |k| a[k] - b[k]));
        let rms = (off.map(|x| x * x).sum::<f64>() / reactions.len() as f64).sqrt() / peak;
        println!("{hz} Hz: rms {:.4} % of {peak:.3} N", 100.0 * rms);
        rms
    });
    // The force of the middle of a step acts on the shape at its end, which is of first order.
    assert!(errors[0] < 1.1e-3 && errors[1] < 5.5e-4 && errors[2] < 2.7e-4, "{errors:?}");
    for pair in errors.windows(2) {
        assert!(pair[0] / pair[1] > 1.8, "half the step, half of the error: {errors:?}");
    }
}

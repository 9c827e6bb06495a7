//! A matrix of stiff, extreme and unfair cases, each with a bound and its margin.
//!
//! A bound compares a measured number with a limit. The margin of a case is `limit / measured` of
//! its tightest bound, at most 1e12: with 1 the bound just holds, with 10 it holds ten times over.
//! In cases with hands, the paper's plain scheme (average acceleration, hands as rigid position
//! constraints) runs the same script, and its result stands beside. Over networks it is the paper's
//! repair, and none, with the default's repeats and playout delay, and with the paper's integrator
//! at both ends.

mod bodies;
mod contact;
mod device;
mod elements;
mod hands;
mod inputs;
mod material;
mod motion;
mod network;
mod page;
mod plain;
mod reduced;
mod solid;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Mutex,
    time::Instant,
};

use pliant_bake::BakeError;
use pliant_modal::Body;
use rayon::prelude::*;
use serde::Serialize;

use crate::{LabError, experiment::Experiment, machine, progress::Progress};

/// Largest number of threads that run cases.
const MAX_THREADS: usize = 64;

/// Settings of a run.
#[derive(Debug, Clone, Default)]
pub struct StabilitySettings {
    /// Run only cases whose group or name contains this text. Default: all.
    pub only: Option<String>,
    /// Number of threads, at most 64. Default: one per core.
    pub threads: Option<usize>,
}

/// A number that must not exceed a limit.
#[derive(Serialize, Debug, Clone, Copy)]
pub struct Bound {
    /// Name of the measured number, with its unit if it has one.
    pub what: &'static str,
    /// The measured number.
    pub measured: f64,
    /// The limit.
    pub limit: f64,
}

impl Bound {
    fn new(what: &'static str, measured: f64, limit: f64) -> Self {
        Self { what, measured: measured.abs(), limit }
    }

    /// Returns `limit / measured`, or 0 for a number that is not finite.
    pub fn margin(&self) -> f64 {
        const MAX: f64 = 1e12;
        if !self.measured.is_finite() {
            0.0
        } else if self.measured * MAX <= self.limit {
            MAX
        } else {
            self.limit / self.measured
        }
    }

    /// Name, number and limit as text.
    pub fn text(&self) -> String {
        format!("{} {:.3e} <= {:.3e}", self.what, self.measured, self.limit)
    }
}

/// The result of a case.
#[derive(Debug, Default)]
struct CaseOutcome {
    bounds: Vec<Bound>,
    /// The result of the paper's plain scheme with the same script.
    plain: Option<String>,
    /// See [`Verdict::phases`].
    phases: Option<[f64; 2]>,
    /// See [`Verdict::damping`].
    damping: Option<[f64; 2]>,
    /// See [`Verdict::relaxation`].
    relaxation: Option<[f64; 2]>,
}

impl CaseOutcome {
    fn of(bounds: Vec<Bound>) -> Self {
        Self { bounds, ..Self::default() }
    }

    /// Adds the result of the paper's plain scheme.
    fn beside(self, plain: String) -> Self {
        Self { plain: Some(plain), ..self }
    }

    /// Adds what the body's motion depends on in numbers without a unit: the phases of its slowest
    /// and fastest mode in a step, their damping ratios, and its relaxation.
    fn stepped(self, body: &Body) -> Self {
        let step = body.config().step;
        let ends = |of: &dyn Fn(f64, f64) -> f64| {
            let modes: Vec<_> = body.omega().iter().zip(body.damping()).collect();
            let at = |mode: &(&f64, &f64)| of(*mode.0, *mode.1);
            Some([at(modes.first()?), at(modes.last()?)])
        };
        let relaxation = body.config().settings.relaxation;
        Self {
            phases: ends(&|omega, _| omega * step),
            damping: ends(&|omega, damping| damping / (2.0 * omega)),
            relaxation: relaxation.map(|relaxation| [relaxation.ratio, relaxation.time / step]),
            ..self
        }
    }
}

/// A known limit: the case breaks its bound for a reason in the method. `expected` is the only
/// accepted result. Any other result is a failure. A case that passes despite its known limit fails
/// too, so that the entry gets removed.
#[derive(Debug, Clone, Copy)]
struct Limit {
    why: &'static str,
    expected: Expected,
}

#[derive(Debug, Clone, Copy)]
enum Expected {
    /// The bake rejects the mesh, because its modes do not solve the equation accurately enough
    /// ([`BakeError::Inaccurate`]).
    Inaccurate,
    /// At least one bound of these names is broken, with numbers between these two, and every other
    /// bound holds.
    Measured(&'static [(&'static str, f64, f64)]),
}

impl Expected {
    fn holds(self, came: &Result<CaseOutcome, LabError>) -> bool {
        match (self, came) {
            (Self::Inaccurate, Err(LabError::Bake(BakeError::Inaccurate { .. }))) => true,
            (Self::Measured(known), Ok(outcome)) => {
                let broken = || outcome.bounds.iter().filter(|bound| bound.margin() < 1.0);
                let is_known = |b: &Bound| {
                    known
                        .iter()
                        .any(|(what, low, high)| b.what == *what && (*low..=*high).contains(&b.measured))
                };
                broken().next().is_some() && broken().all(is_known)
            }
            _ => false,
        }
    }
}

/// One case of the matrix.
struct Case {
    group: &'static str,
    name: String,
    known_limit: Option<Limit>,
    run: Box<dyn Fn() -> Result<CaseOutcome, LabError> + Send + Sync>,
}

impl Case {
    fn new(
        group: &'static str,
        name: String,
        run: impl Fn() -> Result<CaseOutcome, LabError> + Send + Sync + 'static,
    ) -> Self {
        Self { group, name, known_limit: None, run: Box::new(run) }
    }

    fn limited(self, why: &'static str, expected: Expected) -> Self {
        Self { known_limit: Some(Limit { why, expected }), ..self }
    }
}

/// The verdict on a case.
#[derive(Serialize, Debug, Clone)]
pub struct Verdict {
    /// Name of the case, unique within its group.
    pub name: String,
    /// Group of the case.
    pub group: &'static str,
    /// True if the case keeps all its bounds.
    pub passed: bool,
    /// `limit / measured` of the tightest bound: with 1 the bound just holds. 0 if nothing was
    /// measured.
    pub margin: f64,
    /// The tightest bound as text, or the reason why nothing was measured.
    pub bound: String,
    /// All bounds.
    pub bounds: Vec<Bound>,
    /// Phases `omega h` of the slowest and the fastest mode in a step, rad, for a case of one body
    /// and one step.
    ///
    /// Stiffness, density, size and step act on the motion through them alone: two cases of one
    /// script with equal phases and equal damping ratios differ by rounding only.
    pub phases: Option<[f64; 2]>,
    /// Damping ratios of these two modes.
    pub damping: Option<[f64; 2]>,
    /// Share of the stiffness that relaxes, and the time in which it does, steps.
    pub relaxation: Option<[f64; 2]>,
    /// The reason why the case does not pass, if that is a known limit and the result is the
    /// expected one.
    pub known_limit: Option<&'static str>,
    /// What each number of a known limit may be: its name, the least and the most. None if the
    /// bake refuses the mesh.
    pub permitted: Vec<(&'static str, f64, f64)>,
    /// True if the case is listed as a known limit but passes. The list is out of date, so the case
    /// counts as broken.
    pub limit_gone: bool,
    /// The result of the paper's way with the same script, which [`Verdict::papers_way`] names.
    pub plain: Option<String>,
    /// Run time of the case, s.
    pub seconds: f64,
}

impl Verdict {
    /// Returns true if the case fails without being a known limit, or is listed as one and passes.
    pub fn broken(&self) -> bool {
        self.limit_gone || (!self.passed && self.known_limit.is_none())
    }

    /// What [`Verdict::plain`] is the result of.
    pub fn papers_way(&self) -> &'static str {
        match self.group {
            network::GROUP => {
                "the paper's repair, and none, with the paper's integrator, our repeats and our delay"
            }
            _ => "the paper's plain scheme",
        }
    }
}

/// The verdicts of all cases.
#[derive(Serialize, Debug, Clone)]
pub struct StabilityReport {
    /// The cases in the order of the matrix.
    pub cases: Vec<Verdict>,
    /// Run time of all cases, s.
    pub seconds: f64,
    /// How the matrix was run: date, command, version, machine, seeds and load.
    pub made: String,
}

impl StabilityReport {
    /// Number of broken cases.
    pub fn broken(&self) -> usize {
        self.cases.iter().filter(|case| case.broken()).count()
    }
}

/// All cases in the order of the matrix.
fn all() -> Vec<Case> {
    let mut cases = Vec::new();
    material::cases(&mut cases);
    motion::cases(&mut cases);
    hands::cases(&mut cases);
    reduced::cases(&mut cases);
    elements::cases(&mut cases);
    contact::cases(&mut cases);
    inputs::cases(&mut cases);
    network::cases(&mut cases);
    device::cases(&mut cases);
    cases
}

/// Runs the chosen cases of the matrix. The report is empty if no case matches the settings.
///
/// # Errors
/// Returns [`LabError::Threads`] if the threads cannot be started. Errors within a case become its
/// verdict.
pub fn run(settings: &StabilitySettings, progress: &mut dyn Progress) -> Result<StabilityReport, LabError> {
    let (began, load) = (Instant::now(), machine::load());
    let wanted = |case: &Case| {
        settings
            .only
            .as_ref()
            .is_none_or(|text| case.group.contains(text.as_str()) || case.name.contains(text.as_str()))
    };
    let chosen: Vec<Case> = all().into_iter().filter(wanted).collect();
    let threads = settings.threads.unwrap_or(0);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads.min(MAX_THREADS))
        .build()
        .map_err(|_| LabError::Threads { got: threads, most: MAX_THREADS })?;
    let progress = Mutex::new((progress, 0usize));
    let cases: Vec<Verdict> = pool.install(|| {
        chosen
            .par_iter()
            // Hand out one case at a time, because their run times differ by a factor of a
            // thousand.
            .with_max_len(1)
            .map(|case| {
                let verdict = judge(case);
                if let Ok(mut progress) = progress.lock() {
                    progress.1 += 1;
                    let share = progress.1 as f64 / chosen.len() as f64;
                    progress.0.report("stability", share);
                }
                verdict
            })
            .collect()
    });
    let seconds = began.elapsed().as_secs_f64();
    let only = settings.only.as_ref().map_or_else(String::new, |text| format!(" --only \"{text}\""));
    let seeds =
        format!("The networks have the seed {}, random velocities those of their names", Experiment::SEED);
    let made = machine::made(&format!("pliant stability{only}"), seconds, &seeds, load);
    Ok(StabilityReport { cases, seconds, made })
}

fn judge(case: &Case) -> Verdict {
    let began = Instant::now();
    // A panic fails only its own case. Nothing of that case is used afterwards.
    let came = catch_unwind(AssertUnwindSafe(|| (case.run)()));
    let expected = |came: &Result<CaseOutcome, LabError>| {
        case.known_limit.filter(|limit| limit.expected.holds(came)).map(|limit| limit.why)
    };
    let (margin, bound, outcome, known_limit) = match came {
        Ok(came) => {
            let known_limit = expected(&came);
            match came {
                Ok(outcome) => {
                    let tightest = outcome.bounds.iter().min_by(|a, b| a.margin().total_cmp(&b.margin()));
                    let margin = tightest.map_or(0.0, Bound::margin);
                    let text = tightest.map_or_else(|| "nothing measured".to_owned(), Bound::text);
                    (margin, text, outcome, known_limit)
                }
                Err(error) => (0.0, error.to_string(), CaseOutcome::default(), known_limit),
            }
        }
        Err(payload) => {
            let words = payload.downcast_ref::<String>().map(String::as_str);
            let words = words.or_else(|| payload.downcast_ref::<&str>().copied()).unwrap_or("no words");
            (0.0, format!("panicked: {words}"), CaseOutcome::default(), None)
        }
    };
    let permitted = match case.known_limit.map(|limit| limit.expected) {
        Some(Expected::Measured(known)) if known_limit.is_some() => known.to_vec(),
        _ => Vec::new(),
    };
    let CaseOutcome { bounds, plain, phases, damping, relaxation } = outcome;
    let passed = margin >= 1.0;
    Verdict {
        name: case.name.clone(),
        group: case.group,
        passed,
        margin,
        bound,
        bounds,
        phases,
        damping,
        relaxation,
        known_limit,
        permitted,
        limit_gone: passed && case.known_limit.is_some(),
        plain,
        seconds: began.elapsed().as_secs_f64(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_margin_says_how_far_below_its_limit_a_number_is() {
        assert_eq!(Bound::new("x", 0.5, 1.0).margin(), 2.0);
        assert_eq!(Bound::new("x", -2.0, 1.0).margin(), 0.5);
        assert_eq!(Bound::new("x", f64::NAN, 1.0).margin(), 0.0);
        assert_eq!(Bound::new("x", f64::INFINITY, 1.0).margin(), 0.0);
        assert_eq!(Bound::new("x", 0.0, 1.0).margin(), 1e12);
    }

    #[test]
    fn the_matrix_has_at_least_480_cases_with_names_of_their_own() {
        let cases = all();
        assert!(cases.len() >= 480, "{}", cases.len());
        let mut names: Vec<String> = cases.iter().map(|c| format!("{}: {}", c.group, c.name)).collect();
        names.sort();
        names.windows(2).for_each(|w| assert_ne!(w[0], w[1]));
    }

    #[test]
    fn a_case_that_breaks_its_bound_is_told_so() {
        let broken = Case::new("g", "n".into(), || Ok(CaseOutcome::of(vec![Bound::new("x", 3.0, 1.0)])));
        let judged = judge(&broken);
        assert!(!judged.passed && (judged.margin - 1.0 / 3.0).abs() < 1e-12, "{judged:?}");
        let failed = Case::new("g", "n".into(), || Err(LabError::Threads { got: 0, most: 1 }));
        assert!(!judge(&failed).passed);
    }

    #[test]
    fn a_known_limit_is_one_outcome_and_any_other_fails() {
        let case = |measured: f64, other: f64| {
            let run = move || {
                Ok(CaseOutcome::of(vec![Bound::new("x", measured, 1.0), Bound::new("y", other, 1.0)]))
            };
            let expected = Expected::Measured(&[("x", 2.0, 4.0)]);
            judge(&Case::new("g", "n".into(), run).limited("known", expected))
        };
        let limit = case(3.0, 0.5);
        assert!(!limit.broken() && !limit.passed && limit.known_limit == Some("known"), "{limit:?}");
        // These are worse than known, better than known, another bound broken too, and not a
        // number.
        for (measured, other) in [(5.0, 0.5), (1.5, 0.5), (3.0, 2.0), (f64::NAN, 0.5), (0.5, 3.0)] {
            let judged = case(measured, other);
            assert!(judged.broken() && judged.known_limit.is_none(), "{judged:?}");
        }
        let gone = case(0.5, 0.5);
        assert!(gone.passed && gone.limit_gone && gone.broken(), "{gone:?}");
        // A rejection differs from a measured result, and a rejection for another reason does not
        // count.
        let refused = |expected| {
            let run = || Err(LabError::Threads { got: 0, most: 1 });
            judge(&Case::new("g", "n".into(), run).limited("known", expected))
        };
        assert!(refused(Expected::Inaccurate).broken());
        assert!(refused(Expected::Measured(&[("x", 0.0, 1e9)])).broken());
    }

    #[test]
    fn a_case_that_panics_is_told_and_is_the_only_one_lost() {
        let none: Vec<f64> = Vec::new();
        let run = move || Ok(CaseOutcome::of(vec![Bound::new("x", none[0], 1.0)]));
        let judged = judge(&Case::new("g", "n".into(), run));
        assert!(judged.broken() && judged.bound.starts_with("panicked: index out of bounds"), "{judged:?}");
    }
}

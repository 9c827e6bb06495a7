//! Sessions under faults keep what must hold.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

use pliant_lab::simulate::{FaultKind, SimulateSettings, simulate};

#[test]
fn fifty_sessions_under_faults_keep_what_must_hold() {
    let report = simulate(&SimulateSettings { from: 1, seeds: 50 }, &mut ()).unwrap();
    println!("{report:#?}");
    assert!(report.failures.is_empty(), "{:#?}", report.failures);
    // Every kind of fault came up, and the sessions went on.
    assert_eq!(report.faults.len(), FaultKind::ALL.len(), "{:?}", report.faults);
    assert!(report.ticks > 50 * 1000, "{}", report.ticks);
}

//! Damages the bytes of a corpus and runs a target on them, for some seconds.
//!
//! `PLIANT_FUZZ_SECONDS` sets the seconds for each target (default 4), and `PLIANT_FUZZ_SEED` where
//! the damage starts (default 1). What fails is printed in its shortest form.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestCaseError, TestRng, TestRunner};

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// One of the corpus with some bytes changed, cut, doubled or put before another one; or any bytes.
fn damaged(corpus: Vec<Vec<u8>>) -> impl Strategy<Value = Vec<u8>> {
    let one = prop::sample::select(corpus);
    let bytes = prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6);
    let damage =
        (one.clone(), one, bytes, any::<prop::sample::Index>(), any::<prop::sample::Index>(), 0..6_u8);
    prop_oneof![
        9 => damage.prop_map(|(mut first, second, bytes, at, other, how)| {
            for (at, value) in bytes {
                if !first.is_empty() {
                    let at = at.index(first.len());
                    first[at] = value;
                }
            }
            let (at, other) = (at.index(first.len() + 1), other.index(second.len() + 1));
            match how {
                0 => first.truncate(at),
                1 => {
                    first.truncate(at);
                    first.extend_from_slice(&second[other..]);
                }
                2 => first.extend_from_within(at..),
                3 => {
                    first.splice(at..at, second.iter().copied().take(other));
                }
                _ => {}
            }
            first
        }),
        1 => prop::collection::vec(any::<u8>(), 0..600),
    ]
}

/// Runs a target on its corpus and on damaged copies.
pub fn run(name: &str, corpus: Vec<Vec<u8>>, target: impl Fn(&[u8])) {
    let lasts = Duration::from_secs(number("PLIANT_FUZZ_SECONDS", 4));
    let mut executions = 0;
    for bytes in &corpus {
        target(bytes);
        executions += 1;
    }
    let seed = number("PLIANT_FUZZ_SEED", 1);
    let strategy = damaged(corpus);
    let (began, mut batch) = (Instant::now(), 0_u64);
    while began.elapsed() < lasts {
        let mut bytes = [0; 32];
        bytes[..8].copy_from_slice(&seed.to_le_bytes());
        bytes[8..16].copy_from_slice(&batch.to_le_bytes());
        let config = Config { cases: 64, failure_persistence: None, ..Config::default() };
        let mut runner = TestRunner::new_with_rng(config, TestRng::from_seed(RngAlgorithm::ChaCha, &bytes));
        let outcome = runner.run(&strategy, |bytes| {
            catch_unwind(AssertUnwindSafe(|| target(&bytes))).map_err(|panic| {
                let text = panic.downcast_ref::<String>().cloned();
                TestCaseError::fail(text.unwrap_or_else(|| "a panic".to_owned()))
            })
        });
        assert!(outcome.is_ok(), "{name}, seed {seed}: {}", outcome.unwrap_err());
        executions += 64;
        batch += 1;
    }
    println!("{name}: {executions} executions in {lasts:?}");
    assert!(executions > 64, "{name}");
}

//! Waiting, shared by all these tests.

use std::time::{Duration, Instant};

/// Longest time that a test waits for an event that must happen. It measures nothing. It is far
/// longer than anything here takes on an idle machine, so that a busy machine makes a test slow but
/// never fail.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Pause between two checks of a condition.
const PAUSE: Duration = Duration::from_millis(1);

/// Result of a check: the value that was awaited, or what is still wrong.
pub trait Look {
    type Found;
    fn found(self) -> Result<Self::Found, String>;
}

impl Look for bool {
    type Found = ();
    fn found(self) -> Result<(), String> {
        if self { Ok(()) } else { Err("it is not so".into()) }
    }
}

impl<T> Look for Option<T> {
    type Found = T;
    fn found(self) -> Result<T, String> {
        self.ok_or_else(|| "it is not there".into())
    }
}

impl<T> Look for Result<T, String> {
    type Found = T;
    fn found(self) -> Self {
        self
    }
}

/// Repeats a check until it succeeds. Panics after [`PATIENCE`], with what was awaited and what the
/// last check found wrong.
pub fn wait_for<L: Look>(awaited: &str, mut look: impl FnMut() -> L) -> L::Found {
    let start = Instant::now();
    loop {
        match look().found() {
            Ok(found) => return found,
            Err(off) => assert!(start.elapsed() < PATIENCE, "not within {PATIENCE:?}: {awaited}: {off}"),
        }
        std::thread::sleep(PAUSE);
    }
}

/// Asserts a condition in a check that returns a `Result`. A condition that does not hold yet
/// becomes the check's error, which the panic prints if it never holds.
macro_rules! must {
    ($so:expr) => {
        let so: bool = $so;
        if !so {
            return Err(stringify!($so).to_string());
        }
    };
    ($so:expr, $($said:tt)+) => {
        let so: bool = $so;
        if !so {
            return Err(format!("{}: {}", stringify!($so), format_args!($($said)+)));
        }
    };
}
pub(crate) use must;

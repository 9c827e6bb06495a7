//! The one way in which these tests wait.

use std::time::{Duration, Instant};

/// So long a test waits for anything that must come. It measures nothing: a busy machine makes a
/// test slow and never red, so it is far longer than anything here takes on a machine that is idle.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Between two looks at what is awaited.
const PAUSE: Duration = Duration::from_millis(1);

/// What a look at something awaited finds: that it is there, or what is still off.
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

/// Looks again and again until it is there. Panics after [`PATIENCE`], saying what was awaited and
/// what the last look has found off.
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

/// For a look that returns a `Result`: what must be so, and is not yet, is what the panic says if
/// it never is.
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

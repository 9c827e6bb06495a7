//! A progress bar on stderr if stderr is a terminal. Otherwise nothing is drawn.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use pliant_lab::Progress;

const STEPS: u64 = 1000;

/// One bar that runs through the named stages of a job.
pub(crate) struct Bar {
    bar: ProgressBar,
    stage: &'static str,
}

impl Bar {
    pub(crate) fn new() -> Self {
        // indicatif draws nothing if stderr is not a terminal.
        let bar = ProgressBar::with_draw_target(Some(STEPS), ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("{msg:>10} [{bar:40}] {percent:>3} % {elapsed}") {
            bar.set_style(style.progress_chars("=> "));
        }
        Self { bar, stage: "" }
    }
}

impl Progress for Bar {
    fn report(&mut self, stage: &'static str, share: f64) {
        if self.stage != stage {
            self.stage = stage;
            self.bar.set_message(stage);
        }
        self.bar.set_position((share.clamp(0.0, 1.0) * STEPS as f64) as u64);
    }

    /// Prints one line on stderr that stays, with or without a bar.
    fn warn(&mut self, text: &str) {
        self.bar.suspend(|| eprintln!("pliant: warning: {text}"));
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

//! Progress reports of long measurements.

/// Receives the progress of a measurement. The implementation for `()` ignores all reports.
pub trait Progress: Send {
    /// Reports the share of a stage that is done, 0 to 1.
    fn report(&mut self, stage: &'static str, share: f64);

    /// Reports a warning that does not stop the measurement: one line without a line end.
    fn warn(&mut self, text: &str);
}

impl Progress for () {
    fn report(&mut self, _stage: &'static str, _share: f64) {}

    fn warn(&mut self, _text: &str) {}
}

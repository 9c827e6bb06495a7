//! What a long measurement tells while it runs.

/// Who is told how far a measurement is. `()` is told, too, and says nothing.
pub trait Progress: Send {
    /// A share of this stage is done, 0 to 1.
    fn report(&mut self, stage: &'static str, share: f64);

    /// Something to know that stops nothing: one line without a line end.
    fn warn(&mut self, text: &str);
}

impl Progress for () {
    fn report(&mut self, _stage: &'static str, _share: f64) {}

    fn warn(&mut self, _text: &str) {}
}

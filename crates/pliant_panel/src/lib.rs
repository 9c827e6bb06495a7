//! The live panel.

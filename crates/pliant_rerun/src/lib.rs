//! Bevy plugin that streams Pliant's diagnostics to the rerun viewer or to a file.

//! The figures that README and book tell are those of the report's files and of the tables that
//! programs wrote. A page that rounds must round right.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a failed test should panic")]

mod checks;
mod defaults;
mod networks;
mod page;
mod programs;
mod report;

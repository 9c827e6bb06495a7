//! Encoding of states: the closed-loop encoder, the quantization step of each mode, and the
//! checksum.

pub mod checksum;
pub mod encoder;
pub mod quantization;

//! How states become bytes: the closed-loop encoder, how coarse each mode may be, and the checksum.

pub mod checksum;
pub mod encoder;
pub mod quantization;

//! Bevy plugin that carries Pliant's streaming sessions over QUIC.

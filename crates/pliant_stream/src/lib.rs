//! What crosses the network and what repairs it: frames, loss, prediction, compensation, sessions, link emulator.

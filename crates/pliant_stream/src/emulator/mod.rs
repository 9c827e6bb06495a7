//! A seeded bad network.

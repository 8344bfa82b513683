//! Layering rules.

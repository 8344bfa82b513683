//! March.

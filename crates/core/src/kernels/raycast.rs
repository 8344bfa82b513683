//! Novel view.

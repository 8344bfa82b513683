//! Codec of layered frames.

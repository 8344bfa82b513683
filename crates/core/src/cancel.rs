//! Lets long work check whether anybody still waits for it.

/// Answers whether the result is still wanted. Several threads call it; after one "no" it must keep answering "no".
pub type Wanted<'a> = &'a (dyn Fn() -> bool + Sync);

/// Stands for work that is always wanted.
pub const ALWAYS: Wanted<'static> = &|| true;

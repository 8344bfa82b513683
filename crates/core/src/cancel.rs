//! Long pieces of work ask from time to time whether anybody still waits for them.

/// Answers whether the result is still wanted. Asked by several threads; once it has said no, it must stay with it.
pub type Wanted<'a> = &'a (dyn Fn() -> bool + Sync);

/// For work that is always wanted.
pub const ALWAYS: Wanted<'static> = &|| true;

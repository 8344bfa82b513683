//! The system's allocator, whose waits are told from those of the display loop: all threads of the process meet at its locks, the
//! graphics driver's among them, and those of the map of memory that it has the kernel change.

#![expect(
    unsafe_code,
    reason = "an allocator cannot be written otherwise, nor the system be asked for a thread's switches"
)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use crate::waits::excuse;

thread_local! {
    static IS_TOLD: Cell<bool> = const { Cell::new(false) };
}

/// From now on this thread tells what it waits for in the allocator.
pub(crate) fn tell_waits_of_this_thread() {
    IS_TOLD.set(true);
}

struct Telling;

#[global_allocator]
static ALLOCATOR: Telling = Telling;

fn told<T>(work: impl FnOnce() -> T) -> T {
    // A thread that ends has no such memory any more.
    if !IS_TOLD.try_with(Cell::get).unwrap_or(false) {
        return work();
    }
    let before = voluntary_switches();
    let result = work();
    excuse(voluntary_switches() - before);
    result
}

// SAFETY: the system's allocator does all of it; this counts.
unsafe impl GlobalAlloc for Telling {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        told(|| unsafe { System.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        told(|| unsafe { System.alloc_zeroed(layout) })
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // SAFETY: as the caller promises.
        told(|| unsafe { System.realloc(pointer, layout, new_size) })
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        told(|| unsafe { System.dealloc(pointer, layout) });
    }
}

/// Of this thread, so far.
#[cfg(target_os = "linux")]
pub(crate) fn voluntary_switches() -> u64 {
    // SAFETY: a structure of numbers, for which zeros are a value.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: the structure is there and ours.
    let result = unsafe { libc::getrusage(libc::RUSAGE_THREAD, &raw mut usage) };
    if result == 0 { usage.ru_nvcsw as u64 } else { 0 }
}

/// Nothing is counted elsewhere.
#[cfg(not(target_os = "linux"))]
pub(crate) fn voluntary_switches() -> u64 {
    0
}

//! What the allocator of glibc keeps of memory that is free. Other allocators have no such settings.

/// From now on, the memory of a page goes back to the system when the page goes. Otherwise the allocator keeps a seventh
/// more than all pages take, in holes.
pub fn return_large_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    set(libc::M_MMAP_THRESHOLD, LARGE_BLOCK);
}

/// From now on, all threads allocate from one arena. Otherwise the allocator keeps for each thread what its largest box
/// took, 24 MB for a conversion in 32 MB. Call it before threads start.
pub fn share_arena() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    set(libc::M_ARENA_MAX, 1);
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn set(name: i32, value: i32) {
    #[expect(unsafe_code, reason = "settings of the C library have no safe binding")]
    // SAFETY: the call may come from any thread at any time.
    let is_set = unsafe { libc::mallopt(name, value) };
    debug_assert!(is_set != 0, "the C library knows these settings");
}

/// Blocks of this size are returned at once, bytes: less than a page takes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGE_BLOCK: i32 = 256 << 10;

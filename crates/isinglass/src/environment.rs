//! What the program changes in its own environment before it begins.

/// Keeps a library of the system from printing errors at each start. Mesa's layer of Vulkan, which orders devices, asks a
/// Wayland server for its device. The library of Wayland prints an error where `XDG_RUNTIME_DIR` says no place for its
/// sockets. There no server can be reached, and a place without one is refused in silence.
///
/// Nothing else may run when this is called.
#[cfg(target_os = "linux")]
pub(crate) fn silence_wayland() {
    let is_absolute =
        |name: &str| std::env::var_os(name).is_some_and(|v| std::path::Path::new(&v).is_absolute());
    let has_socket = std::env::var_os("WAYLAND_SOCKET").is_some();
    if has_socket || is_absolute("XDG_RUNTIME_DIR") || is_absolute("WAYLAND_DISPLAY") {
        return;
    }
    #[expect(unsafe_code, reason = "a change of the environment has no safe call")]
    // SAFETY: the program has one thread as yet.
    unsafe {
        std::env::set_var("WAYLAND_DISPLAY", NO_SOCKET);
    }
}

/// Other systems have no Wayland.
#[cfg(not(target_os = "linux"))]
pub(crate) fn silence_wayland() {}

/// A path that cannot be a socket.
#[cfg(target_os = "linux")]
const NO_SOCKET: &str = "/dev/null";

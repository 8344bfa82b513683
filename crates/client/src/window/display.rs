//! Whether there is a display for a window.

/// Whether a window should open. On Linux and the BSDs, the X server that `DISPLAY` names must accept a connection
/// (on Wayland the window goes through XWayland, which sets `DISPLAY`, too). Elsewhere always.
pub fn display_available() -> bool {
    #[cfg(all(unix, not(target_os = "macos")))]
    return std::env::var("DISPLAY").is_ok_and(|name| x11::answers(&name));
    #[cfg(not(all(unix, not(target_os = "macos"))))]
    return true;
}

#[cfg(all(unix, not(target_os = "macos")))]
mod x11 {
    use std::net::{TcpStream, ToSocketAddrs};
    use std::os::unix::net::UnixStream;
    use std::time::Duration;

    /// Where a display listens: the host (none: this machine) and the number of the display.
    #[derive(Debug, PartialEq)]
    pub(super) struct Address<'a> {
        pub(super) host: Option<&'a str>,
        pub(super) number: u16,
    }

    /// Reads `[host]:number[.screen]`, as in `:0`, `unix:1` or `localhost:10.0`.
    pub(super) fn parse(name: &str) -> Option<Address<'_>> {
        let (host, rest) = name.rsplit_once(':')?;
        let number = rest.split('.').next()?.parse().ok()?;
        let local = host.is_empty() || host == "unix" || host.ends_with("/unix");
        Some(Address { host: (!local).then_some(host), number })
    }

    pub(super) fn answers(name: &str) -> bool {
        match parse(name) {
            None => false,
            Some(Address { host: None, number }) => {
                let path = format!("/tmp/.X11-unix/X{number}");
                UnixStream::connect(&path).is_ok() || answers_abstract(&path)
            }
            Some(Address { host: Some(host), number }) => {
                let Some(port) = FIRST_PORT.checked_add(number) else { return false };
                let Ok(mut addresses) = (host, port).to_socket_addrs() else { return false };
                addresses.any(|a| TcpStream::connect_timeout(&a, TIMEOUT).is_ok())
            }
        }
    }

    /// X servers on Linux also listen on an abstract name, which is all that some containers share.
    #[cfg(target_os = "linux")]
    fn answers_abstract(path: &str) -> bool {
        use std::os::linux::net::SocketAddrExt;
        use std::os::unix::net::SocketAddr;
        SocketAddr::from_abstract_name(path).is_ok_and(|a| UnixStream::connect_addr(&a).is_ok())
    }

    #[cfg(not(target_os = "linux"))]
    fn answers_abstract(_path: &str) -> bool {
        false
    }

    /// TCP port of display 0.
    const FIRST_PORT: u16 = 6000;
    /// A display behind ssh answers on this machine; nobody waits longer for another.
    const TIMEOUT: Duration = Duration::from_millis(500);

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn display_names() {
            assert_eq!(parse(":0"), Some(Address { host: None, number: 0 }));
            assert_eq!(parse("unix:12.1"), Some(Address { host: None, number: 12 }));
            assert_eq!(parse("localhost:10.0"), Some(Address { host: Some("localhost"), number: 10 }));
            for bad in ["", "0", ":", ":x", "host", ":99999"] {
                assert_eq!(parse(bad), None, "{bad}");
            }
        }

        #[test]
        fn a_display_that_is_not_there_does_not_answer() {
            assert!(!answers(":65535"));
            assert!(!answers("localhost:59535"));
            assert!(!answers("nonsense"));
        }
    }
}

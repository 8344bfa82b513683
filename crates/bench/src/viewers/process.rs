//! A server in a process of its own, with its memory and processor time as Linux tells them.

use std::process::Child;
use std::time::Duration;

use isinglass_net::Link;

/// A running server. It ends when this is dropped.
pub struct ServerProcess {
    child: Child,
    links: Vec<Link>,
}

impl ServerProcess {
    /// A server that has printed its links.
    pub fn new(child: Child, links: Vec<Link>) -> Self {
        Self { child, links }
    }

    /// A link for each viewer.
    pub(crate) fn links(&self) -> &[Link] {
        &self.links
    }

    /// Its memory now, bytes.
    pub(crate) fn memory(&self) -> Option<u64> {
        number_of(&self.read("status")?, "VmRSS:")
    }

    /// Its most memory since the start, or since it was forgotten, bytes.
    pub(crate) fn peak_memory(&self) -> Option<u64> {
        number_of(&self.read("status")?, "VmHWM:")
    }

    /// From now on the peak is that of what follows.
    pub(crate) fn forget_peak(&self) {
        // Without permission the peak includes the start.
        let _ = std::fs::write(self.place("clear_refs"), "5");
    }

    /// Processor time of all its threads.
    pub(crate) fn processor_time(&self) -> Option<Duration> {
        ticks_of(&self.read("stat")?).map(|ticks| Duration::from_millis(ticks * MILLIS_PER_TICK))
    }

    fn read(&self, file: &str) -> Option<String> {
        std::fs::read_to_string(self.place(file)).ok()
    }

    fn place(&self, file: &str) -> String {
        format!("/proc/{}/{file}", self.child.id())
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A number of kilobytes in `status`, in bytes.
fn number_of(status: &str, name: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Time of a process in the system's ticks, in user and system mode. The name before it may hold anything.
fn ticks_of(stat: &str) -> Option<u64> {
    let (_, after) = stat.rsplit_once(')')?;
    let mut times = after.split_whitespace().skip(11).map(|word| word.parse::<u64>().ok());
    Some(times.next()?? + times.next()??)
}

/// Linux tells times to programs in hundredths of a second.
const MILLIS_PER_TICK: u64 = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_linux_tells_is_read() {
        let status = "VmPeak:\t  999 kB\nVmHWM:\t    2048 kB\nVmRSS:\t    1024 kB\n";
        assert_eq!(
            (number_of(status, "VmHWM:"), number_of(status, "VmRSS:")),
            (Some(2 << 20), Some(1 << 20))
        );
        assert_eq!(number_of("VmHWM: many", "VmHWM:"), None);
        let stat = "42 (a) b) c) S 1 2 3 4 5 6 7 8 9 10 150 50 0 0 20 0 9 0";
        assert_eq!(ticks_of(stat), Some(200));
        assert_eq!((ticks_of("42 (a) S 1"), ticks_of("")), (None, None));
    }
}

//! The memory limit for volumes.

use anyhow::{Result, bail};
use clap::Args;
use isinglass_client::format_bytes;
use isinglass_core::volume::Volume;
use isinglass_formats::LEAST_FOR_PAGES;

/// The limit, and its default.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct MemoryArgs {
    /// Most memory for volumes, shown and being read, such as 12GB or 500MB. The rest is for frames, 256 MiB to 4 GiB,
    /// and for times read ahead [default: three quarters of the machine's]
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
    max_memory: Option<u64>,
}

impl MemoryArgs {
    /// The limit in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        self.max_memory.unwrap_or_else(|| of_machine().map_or(UNKNOWN_MACHINE, |bytes| bytes / 4 * 3))
    }

    /// Most memory of all frames beside a volume, bytes.
    pub(crate) fn frame_bytes(&self, volume: &Volume) -> u64 {
        of_frames(self.bytes(), of_volume(volume))
    }
}

/// Whether the system gives this process the memory that every command takes. Later, where an allocation fails, the process
/// ends without a word.
///
/// # Errors
/// One line with what to change.
pub(crate) fn check_room() -> Result<()> {
    // The pages are never touched, so this costs nothing.
    let mut room = Vec::<u8>::new();
    let is_there = room.try_reserve_exact(LEAST_ROOM).is_ok();
    // Otherwise the compiler leaves the reservation out.
    std::hint::black_box(&mut room);
    if !is_there {
        bail!(
            "the system gives this process less than {} of memory; allow more with `ulimit -v`, or end other programs",
            format_bytes(LEAST_ROOM as u64)
        );
    }
    Ok(())
}

/// Memory of a volume, its pages included, bytes.
pub(crate) fn of_volume(volume: &Volume) -> u64 {
    volume.bytes_in_memory() + volume.paging().map_or(0, |paging| paging.max_bytes)
}

/// Most memory of all frames beside a volume, bytes: what the volume leaves, within bounds. Without frames nobody sees
/// anything, and more than the upper bound is of no use.
pub(crate) fn of_frames(limit: u64, volume_bytes: u64) -> u64 {
    limit.saturating_sub(volume_bytes).clamp(LEAST_FOR_FRAMES, MOST_FOR_FRAMES)
}

/// Checks whether a volume that needs `needed` bytes fits beside the `held` ones; the error is one line.
pub(crate) fn check(name: &str, needed: u64, held: u64, limit: u64) -> Result<(), String> {
    if needed.saturating_add(held) <= limit {
        return Ok(());
    }
    // With so much room, what can be read by pages was not refused.
    let has_room = limit.saturating_sub(held) >= LEAST_FOR_PAGES;
    let advice =
        if has_room { "; `isinglass convert` makes an OME-Zarr image that is read by pages" } else { "" };
    let (needed, limit) = (format_bytes(needed), format_bytes(limit));
    let beside = match held {
        0 => String::new(),
        held => format!(" beside {} of what is shown", format_bytes(held)),
    };
    Err(format!(
        "{name}: needs {needed} of memory{beside}, expected at most {limit} in all (--max-memory){advice}"
    ))
}

/// `12GB`, `1.5GiB`, `500MB`, or a number of bytes.
fn parse_bytes(text: &str) -> Result<u64, String> {
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let factor = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kb" | "k" => 1e3,
        "mb" | "m" => 1e6,
        "gb" | "g" => 1e9,
        "tb" | "t" => 1e12,
        "kib" => 1024.0,
        "mib" => 1024f64.powi(2),
        "gib" => 1024f64.powi(3),
        "tib" => 1024f64.powi(4),
        _ => f64::NAN,
    };
    let bytes = number.parse::<f64>().ok().map(|n| n * factor).filter(|b| (1.0..=1e15).contains(b));
    bytes.map(|b| b as u64).ok_or_else(|| "expected a size such as 12GB, 500MB or 1.5GiB".into())
}

/// Memory of this machine, or of this process's container, bytes.
fn of_machine() -> Option<u64> {
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let number = |text: String| text.trim().parse::<u64>().ok();
    #[cfg(target_os = "macos")]
    let machine = std::process::Command::new("/usr/sbin/sysctl")
        .args(["-n", "hw.memsize"])
        .output()
        .ok()
        .and_then(|o| number(String::from_utf8_lossy(&o.stdout).into_owned()));
    #[cfg(not(target_os = "macos"))]
    let machine = read("/proc/meminfo").and_then(|text| total_of(&text));
    let group = read("/sys/fs/cgroup/memory.max").and_then(number);
    machine.into_iter().chain(group).min()
}

/// `MemTotal` of Linux, in bytes.
fn total_of(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// What every command can take at its start: threads with their stacks, and the first buffers.
const LEAST_ROOM: usize = 512 << 20;
/// Bounds of the memory for frames.
const LEAST_FOR_FRAMES: u64 = 256 << 20;
const MOST_FOR_FRAMES: u64 = 4 << 30;
/// The limit if the machine does not report its memory: a volume of 2048³ bytes.
const UNKNOWN_MACHINE: u64 = 8 << 30;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_nonsense_is_refused() {
        for (text, bytes) in [
            ("12GB", 12_000_000_000),
            ("1.5gib", 3 << 29),
            ("500 MB", 500_000_000),
            ("4096", 4096),
            ("2k", 2000),
        ] {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
        for bad in ["", "0", "-1GB", "GB", "12 parsecs", "1e9", "nan", "inf", "1.2.3MB"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn what_is_held_counts_and_the_line_says_all_numbers() {
        assert!(check("a", 60, 40, 100).is_ok());
        let line = check("a.nii, time 3", 3_210_000_000, 3_000_000_000, 4_000_000_000).unwrap_err();
        for word in ["a.nii, time 3", "3.2 GB", "3.0 GB of what is shown", "at most 4.0 GB", "--max-memory"] {
            assert!(line.contains(word), "{line}");
        }
        assert!(line.contains("`isinglass convert`"), "{line}");
        let without = check("a", 60 << 20, 50 << 20, 100 << 20).unwrap_err();
        assert!(!without.contains("convert"), "there is no room for pages: {without}");
        assert!(!check("a", u64::MAX, 0, 1).unwrap_err().contains("beside"));
        assert!(check("a", u64::MAX, u64::MAX, u64::MAX - 1).is_err());
    }

    #[test]
    fn frames_get_what_the_volume_leaves() {
        assert_eq!(of_frames(3 << 30, 2 << 30), 1 << 30);
        assert_eq!((of_frames(100, 100), of_frames(u64::MAX, 0)), (LEAST_FOR_FRAMES, MOST_FOR_FRAMES));
    }

    #[test]
    fn the_total_of_a_machine_is_found() {
        assert_eq!(total_of("MemFree: 5 kB\nMemTotal:       16384 kB\n"), Some(16 << 20));
        assert_eq!(total_of("MemTotal: many"), None);
        assert!(MemoryArgs::default().bytes() > 0);
    }
}

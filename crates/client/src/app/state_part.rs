//! Which part of a server's file a state names: its channel, time, level, series and region.

use isinglass_core::wire::{Choices, Part, VolumeDescription};
use isinglass_formats::{Flip, SavedVolume};

/// Where a state's volume is, as seen from what the server shows.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum StatePart {
    /// It is shown, as far as can be told.
    Shown,
    /// It is another part of the same file.
    Other(Part),
    /// It is not in this file; a line says why.
    Elsewhere(String),
}

impl StatePart {
    /// Finds the volume `saved`. `shown` is what the server shows, `parts` what its file holds.
    pub(crate) fn of(saved: &SavedVolume, shown: &VolumeDescription, parts: &Choices) -> Self {
        if !names_part(saved) {
            return Self::Shown;
        }
        let numbers = [
            ("channel", saved.channel, parts.num_channels),
            ("time", saved.time, parts.num_times),
            ("level", saved.level, (parts.levels.len() as u32).max(1)),
            ("series", saved.series, parts.num_series),
        ];
        for (what, number, count) in numbers {
            if let Some(number) = number.filter(|n| *n >= count) {
                let last = count - 1;
                return Self::Elsewhere(format!(
                    "the state is of {what} {number} of {saved}; this file has {what} 0 to {last}"
                ));
            }
        }
        let now = parts.shown;
        let region = saved.selection().ok().and_then(|s| s.region).map(|r| {
            let end = |i: usize| r.max[i].unwrap_or(u32::MAX);
            std::array::from_fn(|i| [r.min[i], end(i)])
        });
        let wanted = Part {
            channel: saved.channel.or(if parts.joins_channels { None } else { now.channel }),
            time: saved.time.or(now.time),
            level: saved.level.or(now.level),
            series: saved.series.or(now.series),
            region,
            flip: saved.selection().map_or(now.flip, |s| s.flip.0),
        };
        let grid = |part: &Part| (part.level, part.series, voxels(part, parts.whole_dims));
        // Channels and times of a file share one grid. Another level or series has its own, of which at most the size
        // is known.
        let is_of_file = match (wanted.series == now.series, wanted.level == now.level) {
            (true, true) if grid(&wanted) == grid(&now) => {
                saved.dims == shown.dims && saved.spacing == shown.spacing
            }
            (true, false) if region.is_none() => {
                let level = parts.levels.get(wanted.level.unwrap_or(0) as usize);
                level.is_some_and(|dims| *dims == saved.dims.map(u64::from))
            }
            _ => true,
        };
        if !is_of_file {
            let other = saved.difference(&SavedVolume::of(shown));
            return other.map_or(Self::Shown, Self::Elsewhere);
        }
        let is_alike = |part: &Part| (part.channel, part.time, part.flip);
        let is_shown = is_alike(&wanted) == is_alike(&now) && grid(&wanted) == grid(&now);
        if is_shown { Self::Shown } else { Self::Other(wanted) }
    }
}

pub(crate) fn names_part(saved: &SavedVolume) -> bool {
    let SavedVolume { channel, time, level, series, region, flip, .. } = saved;
    [channel, time, level, series].into_iter().any(Option::is_some) || region.is_some() || flip.is_some()
}

pub(crate) fn save_part(volume: SavedVolume, part: &Part) -> SavedVolume {
    let &Part { channel, time, level, series, region, flip } = part;
    let region = region.map(|ends| {
        let end = |to: u32| if to == u32::MAX { String::new() } else { to.to_string() };
        ends.map(|[from, to]| format!("{from}:{}", end(to))).join(",")
    });
    let flip = Some(Flip(flip)).filter(|f| *f != Flip::default()).map(|f| f.to_string());
    SavedVolume { channel, time, level, series, region, flip, ..volume }
}

/// The voxels of a part along each axis, if the whole has `whole` voxels.
fn voxels(part: &Part, whole: [u64; 3]) -> [[u64; 2]; 3] {
    std::array::from_fn(|i| {
        let [from, to] = part.region.map_or([0, u32::MAX], |region| region[i]);
        [u64::from(from), u64::from(to).min(whole[i])]
    })
}

#[cfg(test)]
mod tests {
    use isinglass_core::volume::Histogram;
    use isinglass_core::volume::procedural::Builtin;

    use super::*;

    fn shown() -> VolumeDescription {
        let volume = Builtin::Shells.volume(8);
        VolumeDescription::of(&volume, &Histogram::of(&volume))
    }

    fn parts() -> Choices {
        Choices {
            shown: Part {
                channel: Some(0),
                time: Some(1),
                level: Some(0),
                series: Some(0),
                ..Part::default()
            },
            whole_dims: [8; 3],
            num_channels: 3,
            num_times: 4,
            num_series: 2,
            levels: vec![[8; 3], [4; 3]],
            ..Choices::default()
        }
    }

    fn saved(change: impl FnOnce(&mut SavedVolume)) -> SavedVolume {
        let mut saved = save_part(SavedVolume::of(&shown()), &parts().shown);
        change(&mut saved);
        saved
    }

    fn of(change: impl FnOnce(&mut SavedVolume)) -> StatePart {
        StatePart::of(&saved(change), &shown(), &parts())
    }

    #[test]
    fn channels_times_levels_and_series_of_the_file_are_found() {
        assert_eq!(of(|_| ()), StatePart::Shown);
        let now = parts().shown;
        let other = |part| StatePart::Other(part);
        // The range is another in every channel.
        let range = [-3.0, 9.0];
        assert_eq!(of(|v| (v.channel, v.range) = (Some(2), range)), other(Part { channel: Some(2), ..now }));
        assert_eq!(of(|v| (v.time, v.range) = (Some(3), range)), other(Part { time: Some(3), ..now }));
        assert_eq!(of(|v| (v.level, v.dims) = (Some(1), [4; 3])), other(Part { level: Some(1), ..now }));
        // No channel is all of them, if the file shows them together.
        assert_eq!(of(|v| v.channel = None), StatePart::Shown);
        let joined = Choices { joins_channels: true, ..parts() };
        let all = StatePart::of(&saved(|v| v.channel = None), &shown(), &joined);
        assert_eq!(all, other(Part { channel: None, ..now }));
        // Of another series nothing is known before it is read.
        assert_eq!(of(|v| (v.series, v.dims) = (Some(1), [77; 3])), other(Part { series: Some(1), ..now }));
        // A state of a program that named no part.
        assert_eq!(StatePart::of(&SavedVolume::of(&shown()), &shown(), &parts()), StatePart::Shown);
    }

    #[test]
    fn a_region_is_one_however_it_is_written() {
        let now = parts().shown;
        assert_eq!(of(|v| v.region = Some("0:8,:,:".into())), StatePart::Shown, "all of it");
        let half = of(|v| (v.region, v.dims) = (Some(":4,:,:".into()), [4, 8, 8]));
        let region = Some([[0, 4], [0, u32::MAX], [0, u32::MAX]]);
        assert_eq!(half, StatePart::Other(Part { region, ..now }));
        // And back to the whole.
        let parts = Choices { shown: Part { region, ..now }, ..parts() };
        let half = VolumeDescription { dims: [4, 8, 8], ..shown() };
        assert_eq!(StatePart::of(&saved(|_| ()), &half, &parts), StatePart::Other(now));
        let again = save_part(SavedVolume::of(&half), &parts.shown);
        assert_eq!(again.region.as_deref(), Some("0:4,0:,0:"));
        assert_eq!(StatePart::of(&again, &half, &parts), StatePart::Shown);
    }

    #[test]
    fn another_file_is_told_from_another_part() {
        let line = |change: fn(&mut SavedVolume)| match of(change) {
            StatePart::Elsewhere(line) => line,
            found => panic!("{found:?}"),
        };
        let none = line(|v| v.channel = Some(3));
        assert!(
            none.starts_with("the state is of channel 3 of") && none.ends_with("channel 0 to 2"),
            "{none}"
        );
        for change in [
            |v: &mut SavedVolume| (v.channel, v.dims) = (Some(2), [9, 8, 8]),
            |v: &mut SavedVolume| (v.time, v.spacing) = (Some(2), [1.0; 3]),
            |v: &mut SavedVolume| (v.level, v.dims) = (Some(1), [5; 3]),
        ] {
            assert!(line(change).contains("the state was made of"));
        }
    }
}

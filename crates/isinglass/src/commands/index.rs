//! `index`: reads a large volume once, and keeps what is known of its values.

use anyhow::{Context, Result};
use clap::Args;

use crate::args::{VolumeArgs, with_percent};
use crate::memory::MemoryArgs;
use crate::report::print;

#[derive(Args)]
pub(crate) struct IndexArgs {
    #[command(flatten)]
    memory: MemoryArgs,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: &IndexArgs) -> Result<()> {
    let paged = args.volume.open_paged(&args.memory)?;
    let known = paged.index.as_ref().filter(|_| paged.is_indexed());
    let (index, file) = match known {
        Some(index) => ((**index).clone(), paged.index_file()),
        None => {
            let built =
                with_percent("reading all voxels", |progress| paged.build_index(Some(progress), None))?;
            let file = paged.keep_index(&built)?;
            (built.index, file)
        }
    };
    let file = file.context("there is no folder for it, expected XDG_CACHE_HOME or HOME")?;
    let [x, y, z] = index.pages();
    let num_pages = u64::from(x) * u64::from(y) * u64::from(z);
    let channels = match index.num_channels() {
        1 => String::new(),
        n => format!(" of each of {n} channels"),
    };
    let mut text = format!("{num_pages} pages{channels} in {}\n", file.display());
    for (i, (scale, offset)) in paged.source.pyramid().value_maps.iter().enumerate() {
        let (lo, hi) = index.stored_range(i);
        text += &format!("  channel {i:<4} {} to {}\n", lo * scale + offset, hi * scale + offset);
    }
    if paged.num_absent() > 0 {
        text += &format!("  absent       {} chunks, which have the fill value\n", paged.num_absent());
    }
    print(&text)
}

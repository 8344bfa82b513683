//! `compare`: the difference of two pictures.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;
use isinglass_bench::output::Rgb8;
use isinglass_core::image_error;

use crate::args::parse_background;
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct CompareArgs {
    /// A PNG file
    #[arg(value_name = "A")]
    a: PathBuf,
    /// Another PNG file
    #[arg(value_name = "B")]
    b: PathBuf,
    /// The colour that does not count as object
    #[arg(long, value_name = "#RRGGBB", value_parser = parse_background, default_value = "#000000")]
    background: [u8; 3],
    /// As JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &CompareArgs) -> Result<()> {
    let a = Rgb8::read(&args.a, args.background)?;
    let b = Rgb8::read(&args.b, args.background)?;
    if (a.width, a.height) != (b.width, b.height) {
        bail!(
            "{}: found {}x{} pixels, expected {}x{} as in {}",
            args.b.display(),
            b.width,
            b.height,
            a.width,
            a.height,
            args.a.display()
        );
    }
    let e = image_error::compare(&a.bytes, &b.bytes, a.width as usize, a.height as usize, args.background)?;
    if args.json {
        return print_json(&e);
    }
    print(&format!(
        "DSSIM         {:.6}\nSSIM          {:.6}\nPSNR          {:.2} dB\ngreatest      {} of 255\nDSSIM object  {:.6}\n",
        e.dssim, e.ssim, e.psnr_db, e.max_abs_255, e.dssim_object
    ))
}

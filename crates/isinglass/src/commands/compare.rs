//! `compare`: the difference of two pictures.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use image::{ImageFormat, ImageReader};
use isinglass_bench::progress::note;
use isinglass_core::image_error;
use isinglass_formats::png::Rgb8;

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
    let a = read(&args.a, args.background)?;
    let b = read(&args.b, args.background)?;
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

/// Reads a PNG file. Transparent pixels are put on `background`.
fn read(path: &Path, background: [u8; 3]) -> Result<Rgb8> {
    let name = || path.display().to_string();
    let reader = ImageReader::new(std::io::BufReader::new(isinglass_formats::open_file(path)?));
    let reader = reader.with_guessed_format().with_context(name)?;
    ensure!(reader.format() == Some(ImageFormat::Png), "{}: not a PNG picture, by its first bytes", name());
    let decoded = reader.decode().with_context(name)?;
    let color = decoded.color();
    if color.bytes_per_pixel() > color.channel_count() {
        note(&format!("note: {} has 16 bits a channel, of which the upper 8 are taken", name()));
    }
    let (width, height) = (decoded.width(), decoded.height());
    let blend = |c: u8, behind: u8, alpha: u8| {
        let sum = u32::from(c) * u32::from(alpha) + u32::from(behind) * u32::from(255 - alpha);
        ((sum + 127) / 255) as u8
    };
    let rgba = decoded.into_rgba8();
    let bytes =
        rgba.pixels().flat_map(|p| std::array::from_fn::<_, 3, _>(|i| blend(p[i], background[i], p[3])));
    Ok(Rgb8 { width, height, bytes: bytes.collect() })
}

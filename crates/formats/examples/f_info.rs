//! Scratch.
#![allow(
    clippy::all,
    clippy::print_stdout,
    clippy::unwrap_used,
    missing_docs,
    clippy::allow_attributes_without_reason
)]
use isinglass_formats::*;
fn main() {
    let mut args: Vec<String> =
        std::env::args_os().skip(1).map(|s| s.to_string_lossy().into_owned()).collect();
    let stored = args.iter().position(|a| a == "--stored").map(|i| args.remove(i)).is_some();
    for a in args {
        let o = OpenOptions { stored_slices: stored, ..OpenOptions::default() };
        println!("=== {a}");
        match outline(&a, &o) {
            Err(e) => {
                println!("E {e}");
                continue;
            }
            Ok(l) => {
                print!("{l}");
                println!("  dims {:?} spacing {:?} {}", l.dims, l.spacing, l.dtype);
            }
        }
        match open(&a, &o) {
            Err(e) => println!("E {e}"),
            Ok(v) => {
                let (lo, hi) = v.value_range();
                let [x, y, z] = v.dims().map(|d| d as usize);
                let mean = |k: usize| {
                    let n = x * y;
                    (0..n).map(|i| v.voxels().get(k * n + i) as f64).sum::<f64>() / n as f64
                };
                println!(
                    "  range {lo} {hi} stored means by slice {:?}",
                    (0..z.min(14)).map(|k| (mean(k) * 100.0).round() / 100.0).collect::<Vec<_>>()
                );
                for w in &v.info.warnings {
                    println!("  note: {w}");
                }
            }
        }
    }
}

//! The report for people.

use super::{CodecReport, Distortion, Point, TimeRow};

/// Tables of the points on a front, of BD-rates and of sequences.
pub fn table(report: &CodecReport) -> String {
    let angles = &report.conditions.subject.angles_deg;
    let turns =
        |name: &str| angles.iter().map(|a| format!(" {:>9}", format!("{name} {a}°"))).collect::<String>();
    let mut text = format!(
        "{:<12} {:>2} {:<18} {:<36} {:>9} {:>7} {:>8}{}{} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}\n",
        "scene",
        "k",
        "codec",
        "settings",
        "bytes",
        "bit/px",
        "Mbit/s",
        turns("dssim"),
        turns("psnr"),
        "enc ms",
        "dec ms",
        "enc ns/p",
        "dec ns/p",
        "enc c/px",
        "dec c/px"
    );
    for u in &report.uncoded {
        text += &format!(
            "{:<12} {:>2} {:<18} {:<36} {:>9} {:>7} {:>8}{}\n",
            u.scene,
            u.k,
            "-",
            format!("{}, {}×{} lists", u.layering, u.lists[0], u.lists[1]),
            "-",
            "-",
            "-",
            seen(&u.distortion)
        );
    }
    for p in report.points.iter().filter(|p| !p.on_front_deg.is_empty()) {
        text += &row(p);
    }
    let threads = match report.conditions.subject.threads {
        1 => "one thread".to_owned(),
        threads => format!("{threads} threads"),
    };
    let clock =
        report.conditions.clock_mhz.map_or_else(String::new, |mhz| format!(", cycles at {mhz:.0} MHz"));
    text += &format!("\ntimes are those of {threads}{clock}\n");
    if report.conditions.anchor.is_none() {
        text += "\nno BD-rates: no codec is measured that others are compared with; --anchor names one\n";
    }
    if let Some(anchor) = &report.conditions.anchor {
        text += &format!(
            "\nBD-rate over DSSIM against {anchor}, percent of bytes at the same picture; mid: in the middle of both curves\n{:<12} {:>4} {:<18}{}{}\n",
            "scene",
            "k",
            "codec",
            turns("at"),
            turns("mid")
        );
        // Rows of one curve follow each other, one for each turn.
        for rows in report.bd_rates.chunks(angles.len().max(1)) {
            let at = rows.iter().map(|r| cell(r.bd_rate_percent, r.refused.as_deref()));
            let middle = rows.iter().map(|r| cell(r.middle_percent, r.refused.as_deref()));
            let cells = at.chain(middle).collect::<String>();
            text += &format!("{:<12} {:>4} {:<18}{cells}\n", rows[0].scene, k_name(rows[0].k), rows[0].codec);
        }
        for rows in report.bd_means.chunks(angles.len().max(1)) {
            let at = rows.iter().map(|r| cell(r.bd_rate_percent, None));
            let cells = at.chain(rows.iter().map(|r| cell(r.middle_percent, None))).collect::<String>();
            let scenes =
                rows.iter().map(|r| format!("{}/{}", r.scenes, r.scenes + r.refused)).collect::<Vec<_>>();
            text += &format!(
                "{:<12} {:>4} {:<18}{cells}  of {} scenes\n",
                "mean",
                k_name(rows[0].k),
                rows[0].codec,
                scenes.join(", ")
            );
        }
    }
    if !report.sequences.is_empty() {
        text += &format!(
            "\n{:<12} {:>2} {:<18} {:<16} {:>7} {:>10} {:>10} {:>10} {:>8} {:>8}{}\n",
            "sequence",
            "k",
            "codec",
            "settings",
            "frames",
            "B moving",
            "B resting",
            "B intra",
            "Mbit/s",
            "saving",
            format_args!("{}{} {:>7} {:>7}", turns("dssim"), turns("psnr"), "enc ms", "dec ms")
        );
        for s in &report.sequences {
            text += &format!(
                "{:<12} {:>2} {:<18} {:<16} {:>7} {:>10.0} {:>10} {:>10.0} {:>8.2} {:>7.1}%{}\n",
                s.scene,
                s.k,
                s.codec,
                s.settings,
                s.frames,
                s.bytes_moving,
                s.bytes_resting.map_or_else(|| "-".to_owned(), |b| format!("{b:.0}")),
                s.bytes_intra,
                s.mbit_s_at_30_hz,
                s.saving_percent,
                format_args!(
                    "{} {:>7} {:>7}",
                    seen(&s.distortion),
                    number(s.encode_ms, 1),
                    number(s.decode_ms, 1)
                )
            );
        }
        if !report.sequence_gains.is_empty() {
            text += &format!(
                "\nBD-rate of frames that move, predicted against alone, percent\n{:<12} {:>4} {:<18}{}\n",
                "scene",
                "k",
                "codec",
                turns("at")
            );
        }
        for rows in report.sequence_gains.chunks(angles.len().max(1)) {
            let cells =
                rows.iter().map(|r| cell(r.bd_rate_percent, r.refused.as_deref())).collect::<String>();
            text += &format!("{:<12} {:>4} {:<18}{cells}\n", rows[0].scene, rows[0].k, rows[0].codec);
        }
    }
    text + &times(&report.times)
}

/// Times from start to end; nothing if none were taken.
fn times(rows: &[TimeRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "\n{:<12} {:>2} {:<20} {:>7} {:>26} {:>26}\n{:<12} {:>2} {:<20} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}\n",
        "times",
        "k",
        "settings",
        "threads",
        "alone",
        "predicted",
        "",
        "",
        "",
        "",
        "enc ms",
        "dec ms",
        "bytes",
        "enc ms",
        "dec ms",
        "bytes"
    );
    for row in rows {
        let cells = [Some(row.intra), row.inter].into_iter().flatten();
        let cells = cells.map(|t| format!(" {:>8.1} {:>8.1} {:>8}", t.encode_ms, t.decode_ms, t.bytes));
        text += &format!(
            "{:<12} {:>2} {:<20} {:>7}{}\n",
            row.scene,
            row.k,
            row.settings,
            row.threads,
            cells.collect::<String>()
        );
    }
    text
}

fn number(x: Option<f64>, digits: usize) -> String {
    x.map_or_else(|| "-".to_owned(), |x| format!("{x:.digits$}"))
}

fn row(p: &Point) -> String {
    format!(
        "{:<12} {:>2} {:<18} {:<36} {:>9} {:>7.3} {:>8.2}{} {:>8.1} {:>8} {:>8.1} {:>8} {:>8} {:>8}\n",
        p.scene,
        p.k,
        p.codec,
        p.settings,
        p.bytes,
        p.bits_per_pixel,
        p.mbit_s_at_30_hz,
        seen(&p.distortion),
        p.encode_ms,
        number(p.decode_ms, 1),
        p.encode_ns_per_pixel,
        number(p.decode_ns_per_pixel, 1),
        number(p.encode_cycles_per_pixel, 0),
        number(p.decode_cycles_per_pixel, 0)
    )
}

fn seen(distortion: &[Distortion]) -> String {
    let dssim = distortion.iter().map(|d| format!(" {:>9.5}", d.dssim));
    dssim.chain(distortion.iter().map(|d| format!(" {:>9.2}", d.psnr_db))).collect()
}

fn cell(percent: Option<f64>, refused: Option<&str>) -> String {
    // The first word tells: finer or coarser everywhere, or few points.
    let word = refused.and_then(|r| r.split_whitespace().next()).unwrap_or("-");
    percent.map_or_else(|| format!(" {word:>9}"), |p| format!(" {p:>+9.1}"))
}

fn k_name(k: Option<u8>) -> String {
    k.map_or_else(|| "best".to_owned(), |k| k.to_string())
}

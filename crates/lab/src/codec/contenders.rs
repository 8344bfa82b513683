//! The measured codecs: the product's, raw segments with a general compressor, and image codecs on planes.

use crate::rules::Rule;
use isinglass_core::codec::{Coding, blocks};

use super::layout::{Layout, Part};
use super::ours::Ours;
use super::raster::{ImageCodec, Png};
use super::raw::Compressor;
use crate::error::LabError;

pub(crate) struct Contender {
    /// The name on the command line and in tables.
    pub(crate) name: &'static str,
    pub(crate) way: Way,
}

/// How a frame is coded.
pub(crate) enum Way {
    /// By the product, with each of these settings.
    Product(Vec<(String, Coding)>),
    /// As it is in memory.
    Raw(Compressor),
    /// As planes, with settings for each part.
    Planes(Layout, Box<dyn ImageCodec + Send + Sync>),
}

impl Contender {
    pub(crate) fn layering(&self) -> Rule {
        match self.way {
            Way::Planes(..) => Layout::LAYERING,
            Way::Product(_) | Way::Raw(_) => Rule::default(),
        }
    }

    /// Whether it codes frames of projections, whose lists may be out of depth order.
    pub(crate) fn takes_projections(&self) -> bool {
        match &self.way {
            Way::Product(settings) => settings.iter().all(|(_, coding)| matches!(coding, Coding::Exact)),
            Way::Raw(_) => true,
            Way::Planes(..) => false,
        }
    }
}

/// Every codec of this build; blocks have a variant for each of the turns.
pub(crate) fn all(turns_deg: &[Option<u8>]) -> Vec<Contender> {
    let mut all = product(turns_deg);
    all.push(Contender { name: Compressor::Zstd.name(), way: Way::Raw(Compressor::Zstd) });
    all.push(Contender { name: "png-published", way: Way::Planes(Layout::Published, Box::new(Png)) });
    all.push(Contender { name: "blocks-planes", way: Way::Planes(Layout::Weighted, Box::new(Ours)) });
    #[cfg(feature = "rivals")]
    all.extend(others());
    all
}

/// The modes of the product's codec, each with its settings.
fn product(turns_deg: &[Option<u8>]) -> Vec<Contender> {
    let mode = |name, settings: Vec<(String, Coding)>| Contender { name, way: Way::Product(settings) };
    let blocks = turns_deg.iter().flat_map(|&turn_deg| {
        (0..=blocks::MAX_QUALITY).step_by(QUALITY_STEP).map(move |quality| {
            let seen_at = turn_deg.map_or_else(String::new, |turn| format!(", seen at {turn}°"));
            let settings = blocks::Settings { turn_deg, ..blocks::Settings::of(quality) };
            (format!("quality {quality}{seen_at}"), Coding::Blocks(settings))
        })
    });
    vec![mode("blocks", blocks.collect()), mode("exact", vec![("exact".into(), Coding::Exact)])]
}

#[cfg(feature = "rivals")]
fn others() -> Vec<Contender> {
    use super::av1::Av1;
    use super::htj2k::Htj2k;
    use super::jpeg2000::Jpeg2000;
    use super::programs::Program;
    use super::webp::WebP;

    let planes = |name, layout, codec| Contender { name, way: Way::Planes(layout, codec) };
    let mut all = vec![
        Contender { name: Compressor::Lz4.name(), way: Way::Raw(Compressor::Lz4) },
        planes(PUBLISHED, Layout::Published, Box::new(Jpeg2000)),
        planes("jpeg2000-planes", Layout::Weighted, Box::new(Jpeg2000)),
        planes("htj2k-published", Layout::Published, Box::new(Htj2k)),
        planes("htj2k-planes", Layout::Weighted, Box::new(Htj2k)),
        planes(AVIF, Layout::Weighted, Box::new(Av1 { speed: AVIF_SPEED })),
        planes("webp-published", Layout::Published, Box::new(WebP)),
    ];
    let installed = Program::ALL.into_iter().filter(|(_, program)| program.is_installed());
    all.extend(installed.map(|(name, program)| planes(name, Layout::Weighted, Box::new(program))));
    all
}

/// The codecs called `names`, in their order; all without names.
pub(crate) fn select(names: &[String], turns_deg: &[Option<u8>]) -> Result<Vec<Contender>, LabError> {
    let mut all = all(turns_deg);
    if names.is_empty() {
        return Ok(all);
    }
    let mut selected = Vec::with_capacity(names.len());
    for name in names {
        match all.iter().position(|c| c.name == name) {
            Some(i) => selected.push(all.remove(i)),
            None if selected.iter().any(|c: &Contender| c.name == name) => {}
            None => {
                let rivals = if cfg!(feature = "rivals") {
                    "; those of cjxl and djxl, avifenc and avifdec where these are installed"
                } else {
                    "; others are there when it is built with --features rivals"
                };
                let expected = format!("{}{rivals}", super::codec_names().join(", "));
                return Err(LabError::UnknownCodec { found: name.clone(), expected });
            }
        }
    }
    Ok(selected)
}

/// Settings of a part in the order of the search, as (how many times smaller the planes are, level of the codec).
/// Levels of different sizes overlap: which of them is worth its bytes differs from scene to scene, and the search
/// may leave some out. Colours and opacities are half as large, too, if the ladder `has_half` of them.
pub(crate) fn ladder(layout: Layout, part: Part, num_levels: usize, has_half: bool) -> Vec<(u32, usize)> {
    let top = num_levels - 1;
    let whole = (0..num_levels).map(|level| (1, level));
    if layout == Layout::Published || top == 0 {
        return whole.collect();
    }
    if part != Part::Depth {
        let half = 0..if has_half { num_levels.saturating_sub(2) } else { 0 };
        return half.map(|level| (2, level)).chain(whole).collect();
    }
    let below = |n: usize| top.saturating_sub(n);
    let quarter = [6, 5, 4, 3, 2].map(|n| (4, below(n)));
    let half = [4, 3, 2, 1, 0].map(|n| (2, below(n)));
    let whole = [4, 3, 2, 1, 0].map(|n| (1, below(n)));
    let mut rungs = [&quarter[..], &half, &whole].concat();
    rungs.dedup();
    rungs
}

/// Step between measured qualities.
const QUALITY_STEP: usize = 10;
/// What names end with of codecs that code frames as Lochmann 2016 has it.
pub(crate) const AS_PUBLISHED: &str = "-published";
/// JPEG 2000 as published, the reference for others.
pub(crate) const PUBLISHED: &str = "jpeg2000-published";
/// Speed of 10; without assembly slower ones take seconds a frame.
#[cfg(feature = "rivals")]
pub(super) const AVIF_SPEED: u8 = 9;
/// AV1 on weighted planes; in a sequence also with prediction.
#[cfg(feature = "rivals")]
pub(super) const AVIF: &str = "avif-planes";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codecs_are_chosen_by_name_and_unknown_ones_refused_with_all() {
        let select = |names: &[&str]| {
            select(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>(), &[None])
                .map(|all| all.iter().map(|c| c.name).collect::<Vec<_>>())
        };
        assert_eq!(select(&["raw-zstd", "exact", "raw-zstd"]).unwrap(), ["raw-zstd", "exact"]);
        assert_eq!(select(&[]).unwrap(), crate::codec::codec_names());
        let error = select(&["x264"]).unwrap_err().to_string();
        assert!(error.contains("x264") && error.contains("png-published"), "{error}");
        assert_eq!(error.contains("rivals"), !cfg!(feature = "rivals"));
    }

    #[test]
    fn ladders_rise() {
        for num in [1, 2, 7, 8] {
            let kinds =
                [Layout::Published, Layout::Weighted].into_iter().flat_map(|l| Part::ALL.map(|p| (l, p)));
            for ((layout, part), has_half) in kinds.flat_map(|kind| [false, true].map(|half| (kind, half))) {
                let rungs = ladder(layout, part, num, has_half);
                assert!(rungs.windows(2).all(|w| w[0].0 >= w[1].0 && w[0] != w[1]), "{rungs:?}");
                assert!(rungs.iter().all(|(_, level)| *level < num));
                assert_eq!(rungs.last(), Some(&(1, num - 1)));
            }
        }
    }
}

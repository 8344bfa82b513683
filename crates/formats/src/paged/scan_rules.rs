//! How the numbers of all channels are counted and averaged while an index is made.

use super::pages::FilePages;
use crate::convert::average::Rule;
use crate::convert::gaps::{Tally, level_rules, told_gaps};
use crate::decode::offset_in_memory;
use crate::gap_rule::GapRule;
use crate::padding::{GapNumbers, MissingNumbers};

/// The rules, for each channel.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ScanRules {
    /// Which voxels have no value.
    pub(super) gaps: Vec<GapRule>,
    /// How voxels become one.
    pub(super) means: Vec<Rule>,
}

impl ScanRules {
    /// As the coarsest level of a file says.
    pub(super) fn of_base(pages: &FilePages, are_labels: bool) -> Self {
        let plan = &pages.level(0).plan;
        let told = told_gaps(plan);
        let offset = offset_in_memory(plan.dtype);
        let rule = |rule: &GapRule| match rule {
            _ if are_labels => Rule::Majority,
            _ if told != GapNumbers::default() => Rule::Mean(told.clone()),
            rule => {
                let stored = rule.mark.iter().chain(&rule.missing.numbers);
                let numbers = stored.map(|x| f64::from(x + offset)).collect();
                Rule::Mean(GapNumbers { numbers, valid: None })
            }
        };
        Self::new(pages, pages.rules().iter().map(rule).collect())
    }

    /// As all numbers of the file say. Returns the numbers of voxels without a value in all channels, too.
    pub(super) fn of_tallies(pages: &FilePages, tallies: &[Tally], are_labels: bool) -> (GapNumbers, Self) {
        let (gaps, rules) = level_rules(&pages.level(0).plan, tallies, are_labels);
        (gaps, Self::new(pages, rules))
    }

    fn new(pages: &FilePages, means: Vec<Rule>) -> Self {
        let plan = &pages.level(0).plan;
        let is_told = told_gaps(plan) != GapNumbers::default();
        let offset = offset_in_memory(plan.dtype);
        let gap_rule = |(base, rule): (&GapRule, &Rule)| match rule {
            Rule::Mean(gaps) if !is_told => {
                let numbers = gaps.numbers.iter().map(|x| *x as f32 - offset).collect();
                GapRule {
                    mark: None,
                    missing: MissingNumbers { numbers, ..MissingNumbers::default() },
                    ..base.clone()
                }
            }
            _ => base.clone(),
        };
        Self { gaps: pages.rules().iter().zip(&means).map(gap_rule).collect(), means }
    }
}

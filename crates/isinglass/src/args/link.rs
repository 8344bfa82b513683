//! Arguments for the link between server and viewer.

use std::time::Duration;

use anyhow::Result;
use clap::Args;
use isinglass_net::LinkModel;

use super::{parse_duration, usage_error};

/// Properties of the link between server and viewer, beside its round-trip time.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Link")]
pub(crate) struct LinkArgs {
    /// Greatest additional delay of a packet, each way
    #[arg(long, value_name = "TIME", value_parser = parse_duration, default_value = "0ms")]
    jitter: Duration,
    /// Fraction of packets that are lost, each way: 0.01 is one in a hundred
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    loss: f64,
    /// Rate each way, megabits a second [default: unlimited]
    #[arg(long, value_name = "MBIT")]
    bandwidth: Option<f64>,
    /// Seed of the link's random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl LinkArgs {
    /// The link.
    pub(crate) fn model(&self, rtt: Duration) -> Result<LinkModel> {
        let &Self { jitter, loss, bandwidth: bandwidth_mbit, seed } = self;
        let model = LinkModel { rtt, jitter, loss, bandwidth_mbit, seed, ..LinkModel::default() };
        model.validate().map_err(usage_error)?;
        Ok(model)
    }
}

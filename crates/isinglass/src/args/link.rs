//! Arguments for the link between server and viewer.

use std::time::Duration;

use anyhow::Result;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use isinglass_net::{LinkModel, NamedLink};

use super::{parse_duration, usage_error};

/// Properties of the link between server and viewer, beside its round-trip time.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Link")]
pub(crate) struct LinkArgs {
    /// A typical link; other flags change single properties of it
    #[arg(long, value_name = "NAME", value_parser = link_parser())]
    link: Option<NamedLink>,
    /// Greatest additional delay of a packet, each way [default: the link's, or 0ms]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    jitter: Option<Duration>,
    /// Fraction of packets that are lost, each way: 0.01 is one in a hundred [default: the link's, or 0]
    #[arg(long, value_name = "SHARE")]
    loss: Option<f64>,
    /// Mean number of packets that are lost in a row [default: the link's, or 1]
    #[arg(long, value_name = "N")]
    burst: Option<f64>,
    /// Rate each way, megabits a second [default: the link's, or unlimited]
    #[arg(long, value_name = "MBIT")]
    bandwidth: Option<f64>,
    /// Longest wait of a packet for the link; one that had to wait longer is lost [default: the link's, or 200ms]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    queue: Option<Duration>,
    /// Seed of the link's random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl LinkArgs {
    /// The link. Without `rtt` its round-trip time is that of the named link, or else `usual_rtt`.
    pub(crate) fn model(&self, rtt: Option<Duration>, usual_rtt: Duration) -> Result<LinkModel> {
        let usual = || LinkModel { rtt: usual_rtt, ..LinkModel::default() };
        let named = self.link.map_or_else(usual, |link| link.model());
        let model = LinkModel {
            rtt: rtt.unwrap_or(named.rtt),
            jitter: self.jitter.unwrap_or(named.jitter),
            loss: self.loss.unwrap_or(named.loss),
            burst: self.burst.unwrap_or(named.burst),
            bandwidth_mbit: self.bandwidth.or(named.bandwidth_mbit),
            queue: self.queue.unwrap_or(named.queue),
            seed: self.seed,
            ..named
        };
        model.validate().map_err(usage_error)?;
        Ok(model)
    }

    /// Whether a link is named.
    pub(crate) fn is_named(&self) -> bool {
        self.link.is_some()
    }
}

fn link_parser() -> impl TypedValueParser<Value = NamedLink> {
    let values = NamedLink::ALL.map(|link| PossibleValue::new(link.name).help(link.to_string()));
    PossibleValuesParser::new(values)
        .try_map(|name| NamedLink::named(&name).ok_or("there is no link of this name"))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        link: LinkArgs,
    }

    #[test]
    fn flags_change_single_properties_of_a_named_link() {
        let ms = Duration::from_millis;
        let model = |line: &str, rtt| {
            Line::try_parse_from(line.split(' ')).map(|parsed| parsed.link.model(rtt, ms(200)).unwrap())
        };
        assert_eq!(model("_", None).unwrap(), LinkModel { rtt: ms(200), ..LinkModel::default() });
        let lossy = NamedLink::named("lossy").unwrap().model();
        assert_eq!(model("_ --link lossy", None).unwrap(), lossy);
        let changed = model("_ --link lossy --loss 0.01 --queue 50ms --bandwidth 5", Some(ms(40))).unwrap();
        let by_hand =
            LinkModel { rtt: ms(40), loss: 0.01, queue: ms(50), bandwidth_mbit: Some(5.0), ..lossy.clone() };
        assert_eq!(changed, by_hand);
        assert_ne!(changed, lossy);
        assert!(model("_ --link fibre", None).is_err());
    }
}

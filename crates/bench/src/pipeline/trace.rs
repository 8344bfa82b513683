//! The lives of frames as Chrome trace events for chrome://tracing and Perfetto, a row per station.

use isinglass_core::session::ledger::{Life, Stage};
use serde_json::{Value, json};

use crate::error::BenchError;

/// Spans of a life: name, process, row, and the first and last stage.
const SPANS: [(&str, u32, u32, Stage, Stage); 9] = [
    ("asked", CLIENT, 1, Stage::Asked, Stage::Begun),
    ("generate", SERVER, 1, Stage::Begun, Stage::Generated),
    ("wait for the coder", SERVER, 2, Stage::Generated, Stage::CodingBegun),
    ("code", SERVER, 3, Stage::CodingBegun, Stage::Coded),
    ("wait for the network", SERVER, 4, Stage::Coded, Stage::FirstByteSent),
    ("send", SERVER, 5, Stage::FirstByteSent, Stage::LastByteSent),
    ("way", CLIENT, 2, Stage::LastByteSent, Stage::Received),
    ("decode", CLIENT, 3, Stage::DecodingBegun, Stage::Decoded),
    ("wait for the display", CLIENT, 4, Stage::Decoded, Stage::Shown),
];
const SERVER: u32 = 1;
const CLIENT: u32 = 2;

pub(super) fn chrome(lives: &[Life]) -> Result<String, BenchError> {
    let mut events = vec![process(SERVER, "server"), process(CLIENT, "viewer")];
    for (name, pid, tid, _, _) in SPANS {
        events
            .push(json!({"ph": "M", "name": "thread_name", "pid": pid, "tid": tid, "args": {"name": name}}));
    }
    for life in lives {
        let spans = SPANS.iter().filter_map(|&(name, pid, tid, from, to)| {
            let (ts, end) = (life.at(from)?, life.at(to)?);
            let args = json!({"frame": life.frame.0, "pose": life.pose.0, "bytes": life.bytes});
            let dur = end.saturating_sub(ts);
            Some(json!({"ph": "X", "name": name, "pid": pid, "tid": tid, "ts": ts, "dur": dur, "args": args}))
        });
        events.extend(spans);
    }
    let text = serde_json::to_string(&json!({"traceEvents": events, "displayTimeUnit": "ms"}));
    text.map_err(|e| BenchError::Demo(format!("trace: {e}")))
}

fn process(pid: u32, name: &str) -> Value {
    json!({"ph": "M", "name": "process_name", "pid": pid, "args": {"name": name}})
}

#[cfg(test)]
mod tests {
    use isinglass_core::ids::{FrameId, PoseId};

    use super::*;

    #[test]
    fn a_span_is_there_for_each_two_stages_that_were_reached() {
        let life = Life::new(FrameId(3), PoseId(2)).with(Stage::Begun, 100).with(Stage::Generated, 130);
        let text = chrome(&[life]).unwrap();
        let value: Value = serde_json::from_str(&text).unwrap();
        let events = value["traceEvents"].as_array().unwrap();
        let spans: Vec<_> = events.iter().filter(|e| e["ph"] == "X").collect();
        assert_eq!(spans.len(), 1);
        assert_eq!(
            (&spans[0]["name"], &spans[0]["ts"], &spans[0]["dur"]),
            (&json!("generate"), &json!(100), &json!(30))
        );
        assert_eq!(spans[0]["args"]["frame"], json!(3));
    }
}

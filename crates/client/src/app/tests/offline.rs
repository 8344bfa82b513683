//! What the window says while there is no connection.

use isinglass_net::ConnectError;

use super::*;

fn problem() -> ConnectError {
    ConnectError::Lost("gone".into())
}

fn states() -> [State; 2] {
    [State::Reconnecting { since_micros: 0, attempt: 2, problem: problem() }, State::Refused(problem())]
}

#[test]
fn what_rests_is_offline_and_nothing_is_received() {
    let mut w = window([900.0, 700.0]);
    w.state_mut().viewing.source_mut().stats.bytes_per_second = 43_000.0;
    rest(&mut w);
    assert!(w.query_by_label("43 kB/s").is_some() && w.query_by_label("offline").is_none());
    for state in states() {
        w.state_mut().viewing.source_mut().state = state;
        rest(&mut w);
        assert!(w.query_by_label("offline").is_some() && w.query_by_label("0 B/s").is_some());
    }
}

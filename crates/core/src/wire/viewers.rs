//! Who is at a server.

use serde::{Deserialize, Serialize};

use super::ControlError;
use super::control::check_text;
use crate::look::MAX_NAME_BYTES;

/// A viewer of the server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewerEntry {
    /// Its number at this server.
    pub number: u32,
    /// Its name for itself.
    pub name: String,
    /// Whether it is the one that gets this message.
    pub is_own: bool,
    /// The viewer whose frames it gets; `None` if it gets its own.
    pub follows: Option<u32>,
}

pub(super) fn validate(list: &[ViewerEntry]) -> Result<(), ControlError> {
    if list.len() > MAX_VIEWERS {
        return Err(ControlError::Value("number of viewers"));
    }
    list.iter().try_for_each(|viewer| check_text("name", &viewer.name, MAX_NAME_BYTES))
}

/// Most viewers in a list.
pub const MAX_VIEWERS: usize = 128;

//! Threads of one process in place of processes.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use crate::exchange::{Exchange, ExchangeError};

/// One of several threads that exchange words through channels.
pub struct InProcess {
    rank: usize,
    /// To each thread.
    to: Vec<SyncSender<Vec<u32>>>,
    /// From each thread.
    from: Vec<Receiver<Vec<u32>>>,
}

impl InProcess {
    /// One for each of `size` threads, by rank.
    pub fn all(size: usize) -> Vec<Self> {
        let mut all: Vec<Self> =
            (0..size).map(|rank| Self { rank, to: Vec::new(), from: Vec::new() }).collect();
        for sender in 0..size {
            for receiver in 0..size {
                let (to, from) = sync_channel(AHEAD);
                all[sender].to.push(to);
                all[receiver].from.push(from);
            }
        }
        all
    }
}

impl Exchange for InProcess {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.to.len()
    }

    fn all_to_all(&self, words: Vec<Vec<u32>>) -> Result<Vec<Vec<u32>>, ExchangeError> {
        for (rank, (to, words)) in self.to.iter().zip(words).enumerate() {
            to.send(words).map_err(|_| ExchangeError::Gone(rank))?;
        }
        let each = self.from.iter().enumerate();
        each.map(|(rank, from)| from.recv().map_err(|_| ExchangeError::Gone(rank))).collect()
    }

    fn abort(&self) -> ! {
        std::process::abort()
    }
}

/// A thread begins the next exchange before another has taken the words of the last, but no later one.
const AHEAD: usize = 2;

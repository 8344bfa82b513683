//! The processes that `mpirun` started.

use std::time::Duration;

use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::environment::Universe;
use mpi::topology::{Communicator, SimpleCommunicator};
use mpi::traits::{CommunicatorCollectives, Root};

use crate::exchange::{Exchange, ExchangeError};

/// A process of MPI's world. Only the thread that started it talks.
pub(crate) struct Mpi {
    world: SimpleCommunicator,
    /// MPI ends with it.
    _universe: Universe,
}

impl Mpi {
    /// Starts MPI.
    pub(crate) fn start() -> Result<Self, ExchangeError> {
        let (universe, _) =
            mpi::initialize_with_threading(Threading::Funneled).ok_or(ExchangeError::Start)?;
        Ok(Self { world: universe.world(), _universe: universe })
    }
}

impl Exchange for Mpi {
    fn rank(&self) -> usize {
        self.world.rank() as usize
    }

    fn size(&self) -> usize {
        self.world.size() as usize
    }

    fn all_to_all(&self, words: Vec<Vec<u32>>) -> Result<Vec<Vec<u32>>, ExchangeError> {
        let sent: Vec<u64> = words.iter().map(|words| words.len() as u64).collect();
        let mut come = vec![0u64; self.size()];
        self.world.all_to_all_into(&sent[..], &mut come[..]);
        // All must see that it is too much, or the others would wait.
        let most = sent.iter().sum::<u64>().max(come.iter().sum());
        let mut all = vec![0u64; self.size()];
        self.world.all_gather_into(&most, &mut all[..]);
        let most = all.into_iter().max().unwrap_or(0);
        if most > i32::MAX as u64 {
            return Err(ExchangeError::TooMuch { bytes: most * 4, max: i32::MAX as u64 * 4 });
        }
        let (out_counts, out_places) = layout(&sent);
        let (in_counts, in_places) = layout(&come);
        let out = words.concat();
        drop(words);
        let mut found = vec![0u32; come.iter().sum::<u64>() as usize];
        {
            let out = Partition::new(&out[..], out_counts, out_places);
            let mut into = PartitionMut::new(&mut found[..], in_counts, in_places);
            self.world.all_to_all_varcount_into(&out, &mut into);
        }
        let mut rest = &found[..];
        let take = |num: u64| {
            let (here, behind) = rest.split_at(num as usize);
            rest = behind;
            here.to_vec()
        };
        Ok(come.into_iter().map(take).collect())
    }

    fn broadcast(&self, words: Vec<u32>) -> Result<Vec<u32>, ExchangeError> {
        let mut num = [words.len() as u64];
        self.world.process_at_rank(0).broadcast_into(&mut num[..]);
        self.broadcast_words(words, num[0])
    }

    fn broadcast_some_day(&self, words: Vec<u32>) -> Result<Vec<u32>, ExchangeError> {
        let mut num = [words.len() as u64];
        mpi::request::scope(|scope| {
            let root = self.world.process_at_rank(0);
            let mut request = root.immediate_broadcast_into(scope, &mut num[..]);
            while let Err(pending) = request.test() {
                // A blocking call would keep a core busy.
                std::thread::sleep(NAP);
                request = pending;
            }
        });
        self.broadcast_words(words, num[0])
    }

    fn abort(&self) -> ! {
        self.world.abort(1)
    }
}

impl Mpi {
    /// Broadcasts so many words, a number that all know.
    fn broadcast_words(&self, mut words: Vec<u32>, num: u64) -> Result<Vec<u32>, ExchangeError> {
        if num > i32::MAX as u64 {
            return Err(ExchangeError::TooMuch { bytes: num * 4, max: i32::MAX as u64 * 4 });
        }
        words.resize(num as usize, 0);
        self.world.process_at_rank(0).broadcast_into(&mut words[..]);
        Ok(words)
    }
}

/// Counts and places of parts that follow each other; their sum fits.
fn layout(counts: &[u64]) -> (Vec<i32>, Vec<i32>) {
    let mut next = 0;
    let places = counts.iter().map(|&num| {
        let here = next;
        next += num as i32;
        here
    });
    let places = places.collect();
    (counts.iter().map(|&num| num as i32).collect(), places)
}

/// An idle process looks for words so often.
const NAP: Duration = Duration::from_millis(1);

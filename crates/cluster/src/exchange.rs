//! What processes tell each other, whatever carries it.

/// Carries words between processes. All of them call the same functions in the same order.
pub trait Exchange {
    /// The number of this process, from 0.
    fn rank(&self) -> usize;

    /// The number of processes.
    fn size(&self) -> usize;

    /// Sends each process its words, and returns what each sent here, both by rank.
    ///
    /// # Errors
    /// If a process has ended, or there are too many words.
    fn all_to_all(&self, words: Vec<Vec<u32>>) -> Result<Vec<Vec<u32>>, ExchangeError>;

    /// Ends all processes at once, because this one cannot go on.
    fn abort(&self) -> !;

    /// The words of each process, for all of them.
    ///
    /// # Errors
    /// See [`Self::all_to_all`].
    fn all_gather(&self, words: &[u32]) -> Result<Vec<Vec<u32>>, ExchangeError> {
        self.all_to_all(vec![words.to_vec(); self.size()])
    }

    /// The words of each process, for process 0; nothing elsewhere.
    ///
    /// # Errors
    /// See [`Self::all_to_all`].
    fn gather(&self, words: Vec<u32>) -> Result<Option<Vec<Vec<u32>>>, ExchangeError> {
        let mut all = vec![Vec::new(); self.size()];
        all[0] = words;
        let found = self.all_to_all(all)?;
        Ok((self.rank() == 0).then_some(found))
    }

    /// The words of process 0, for all of them.
    ///
    /// # Errors
    /// See [`Self::all_to_all`].
    fn broadcast(&self, words: Vec<u32>) -> Result<Vec<u32>, ExchangeError> {
        let nothing = vec![Vec::new(); self.size()];
        let all = if self.rank() == 0 { vec![words; self.size()] } else { nothing };
        Ok(self.all_to_all(all)?.swap_remove(0))
    }

    /// The same for words that may be long in coming: the others sleep meanwhile, and take no core.
    ///
    /// # Errors
    /// See [`Self::all_to_all`].
    fn broadcast_some_day(&self, words: Vec<u32>) -> Result<Vec<u32>, ExchangeError> {
        self.broadcast(words)
    }

    /// Adds the numbers of all processes, place by place.
    ///
    /// # Errors
    /// See [`Self::all_to_all`].
    fn sum(&self, numbers: &[u64]) -> Result<Vec<u64>, ExchangeError> {
        let words: Vec<u32> = numbers.iter().flat_map(|n| [*n as u32, (n >> 32) as u32]).collect();
        let mut sums = vec![0u64; numbers.len()];
        for words in self.all_gather(&words)? {
            for (sum, [low, high]) in sums.iter_mut().zip(words.as_chunks().0) {
                *sum = sum.wrapping_add(u64::from(*low) | u64::from(*high) << 32);
            }
        }
        Ok(sums)
    }
}

/// Why processes cannot talk.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ExchangeError {
    /// The program was built without MPI.
    #[error("this program was built without MPI, expected one built with --features distributed")]
    WithoutMpi,
    /// MPI has started before.
    #[error("MPI does not start, expected that it has not run in this process before")]
    Start,
    /// A process has ended.
    #[error("process {0} has ended")]
    Gone(usize),
    /// MPI counts words in 31 bits.
    #[error("{bytes} bytes to send at once, expected at most {max}; a smaller picture needs fewer")]
    TooMuch {
        /// Bytes to send or receive.
        bytes: u64,
        /// The most at once.
        max: u64,
    },
}

/// Why processes cannot do something together.
#[derive(Debug, thiserror::Error)]
pub enum ClusterError {
    /// A process has failed, and all of them know.
    #[error("rank {rank}: {text}")]
    Rank {
        /// The first one that failed.
        rank: usize,
        /// Why, in one line.
        text: String,
    },
    /// They cannot talk.
    #[error(transparent)]
    Exchange(#[from] ExchangeError),
    /// One has sent something else than expected.
    #[error(transparent)]
    Parts(#[from] isinglass_core::kernels::PartsError),
    /// What process 0 asks for cannot be read.
    #[error("process 0 asks for something that cannot be read: {0}")]
    Job(String),
}

/// The result of this process, if no process has an error.
///
/// # Errors
/// The error of the first process that has one, for all of them.
pub fn agree<T>(exchange: &dyn Exchange, result: Result<T, String>) -> Result<T, ClusterError> {
    let text = result.as_ref().err().map_or("", |text| if text.is_empty() { "failed" } else { text });
    let words: Vec<u32> = text.bytes().map(u32::from).collect();
    let texts = exchange.all_gather(&words)?;
    let failed = texts.iter().enumerate().find(|(_, words)| !words.is_empty());
    let told = failed.map(|(rank, words)| {
        let bytes: Vec<u8> = words.iter().map(|word| *word as u8).collect();
        ClusterError::Rank { rank, text: String::from_utf8_lossy(&bytes).into_owned() }
    });
    match (told, result) {
        (Some(error), _) => Err(error),
        (None, Ok(done)) => Ok(done),
        (None, Err(text)) => Err(ClusterError::Rank { rank: exchange.rank(), text }),
    }
}

/// Whether all processes found the same.
///
/// # Errors
/// If the processes cannot talk.
pub fn are_alike(exchange: &dyn Exchange, found: &str) -> Result<bool, ClusterError> {
    let words: Vec<u32> = found.bytes().map(u32::from).collect();
    Ok(exchange.all_gather(&words)?.iter().all(|other| *other == words))
}

/// Checks that all processes found the same, such as the header of a file.
///
/// # Errors
/// If one found something else than process 0.
pub fn same_everywhere(exchange: &dyn Exchange, what: &str, found: &str) -> Result<(), ClusterError> {
    let words: Vec<u32> = found.bytes().map(u32::from).collect();
    let all = exchange.all_gather(&words)?;
    let is_same = all[0] == words;
    let expected: String = all[0].iter().map(|word| char::from(*word as u8)).collect();
    agree(exchange, if is_same { Ok(()) } else { Err(format!("{what}: found {found}, expected {expected}")) })
}

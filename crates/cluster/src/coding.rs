//! The coding of a frame whose rows are in all processes. Everybody finds the same bands, rows go to the coder of their
//! band, and the coded bytes to process 0. The bytes are those that one process would make.

use std::sync::Arc;

use isinglass_core::cancel::ALWAYS;
use isinglass_core::codec::blocks::{Reference, Settings};
use isinglass_core::codec::{CodecError, CodedBand, Coding, EncodedFrame, FrameBands};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::layering::parts::{frame_from_words, words_from_rows};
use isinglass_core::kernels::rows_of;
use isinglass_core::layer::{Fineness, FrameHeader, LayeredFrame};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cluster::{Cluster, OwnRows, Stopwatch};
use crate::exchange::ClusterError;
use crate::words::{push_bytes, take_bytes};

/// A frame to be coded.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct CodeJob {
    pub(crate) frame: u64,
    ids: (FrameId, PoseId, LookVersion),
    fineness: Fineness,
    /// Quality, turn and most bands of blocks; otherwise it is exact.
    blocks: Option<(u8, Option<u8>, u8)>,
    is_thinned: bool,
    /// What it is predicted from, and what others will be predicted from by its number.
    pub(crate) reference: Option<u64>,
    pub(crate) number: u64,
}

/// A coded frame, and what others may be predicted from.
pub(crate) type Encoded = (EncodedFrame, Option<Arc<Reference>>);

/// The same in any process: some have no bytes of it.
pub(crate) type EncodedHere = Result<(Option<EncodedFrame>, Option<Arc<Reference>>), CodecError>;

impl CodeJob {
    pub(crate) fn new(
        frame: u64,
        header: &FrameHeader,
        coding: Coding,
        is_thinned: bool,
        (reference, number): (Option<u64>, u64),
    ) -> Self {
        let blocks = match coding {
            Coding::Exact => None,
            Coding::Blocks(Settings { quality, turn_deg, max_bands }) => Some((quality, turn_deg, max_bands)),
        };
        let ids = (header.frame, header.pose, header.look);
        Self { frame, ids, fineness: header.fineness, blocks, is_thinned, reference, number }
    }

    fn coding(&self) -> Coding {
        match self.blocks {
            None => Coding::Exact,
            Some((quality, turn_deg, max_bands)) => Coding::Blocks(Settings { quality, turn_deg, max_bands }),
        }
    }
}

impl Cluster<'_> {
    /// Codes a frame of which this process has some rows, together with the others. A frame in blocks is a reference
    /// in all of them, so all get its bytes. Those of an exact one are in process 0 only.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected. All of them fail alike to code a frame.
    pub(crate) fn code(
        &self,
        own: &OwnRows,
        job: &CodeJob,
        reference: Option<&Reference>,
    ) -> Result<EncodedHere, ClusterError> {
        let (exchange, coding) = (self.exchange(), job.coding());
        let mut watch = Stopwatch::start();
        let thinned;
        let rows = if job.is_thinned {
            let most = LayeredFrame::thin_length(own.num_segments as usize, own.num_filled as usize);
            thinned = own.rows.thinned_to(most);
            &thinned
        } else {
            &own.rows
        };
        let work: Vec<u64> = coding.work_of_rows(rows).into_iter().map(|work| work as u64).collect();
        let work: Vec<usize> = exchange.sum(&work)?.into_iter().map(|work| work as usize).collect();
        let (frame, pose, look) = job.ids;
        let header = FrameHeader { frame, pose, look, fineness: job.fineness, ..rows.header };
        let bands = match coding.bands(header, reference, &work) {
            Ok(bands) => bands,
            Err(e) => return Ok(Err(e)),
        };
        let (share, words_dealt) = self.dealt(rows, &bands)?;
        let dealing = watch.lap();
        let own_bands = bands_of(self.rank(), exchange.size(), bands.num());
        let made: Result<Vec<CodedBand>, CodecError> =
            own_bands.into_par_iter().map(|band| bands.encode(&share, band, ALWAYS)).collect();
        let words = words_from_bands(&made);
        let encoding = watch.lap();
        let lists = match coding {
            Coding::Exact => match exchange.gather(words)? {
                Some(lists) => lists,
                None => return Ok(Ok((None, None))),
            },
            Coding::Blocks(_) => exchange.all_gather(&words)?,
        };
        let words_coded = words_of_others(self.rank(), &lists);
        let all = self.bands_of_all(bands.num(), &lists, made)?;
        let joined = all.and_then(|all| bands.join(all));
        let joining = watch.lap();
        tracing::debug!(?dealing, ?encoding, ?joining, words_dealt, words_coded, "a frame is coded");
        Ok(joined.map(|(encoded, reference)| (Some(encoded), reference)))
    }

    /// The frame with the rows of the bands that this process codes: each process has sent those that it has. Also
    /// returns how many words have come.
    fn dealt(
        &self,
        own: &LayeredFrame,
        bands: &FrameBands<'_>,
    ) -> Result<(LayeredFrame, usize), ClusterError> {
        let (rank, size, num) = (self.rank(), self.exchange().size(), bands.num());
        let height = own.header.camera.intrinsics.height;
        // The rows of a process that one codes.
        let rows_between = |owner: usize, coder: usize| -> Vec<u32> {
            let coded: Vec<_> = bands_of(coder, size, num).into_iter().map(|band| bands.rows(band)).collect();
            let is_coded = |row: &u32| coded.iter().any(|rows| rows.contains(&(*row as usize)));
            rows_of(owner, size, height).into_iter().filter(is_coded).collect()
        };
        let sent = (0..size).map(|coder| words_from_rows(own, &rows_between(rank, coder))).collect();
        let found = self.exchange().all_to_all(sent)?;
        let rows: Vec<_> = (0..size).map(|owner| rows_between(owner, rank)).collect();
        Ok((frame_from_words(own.header, &rows, &found)?, words_of_others(rank, &found)))
    }

    /// All bands, given what each process has sent of its own; or the error of the first that has one.
    fn bands_of_all(
        &self,
        num: usize,
        lists: &[Vec<u32>],
        own: Result<Vec<CodedBand>, CodecError>,
    ) -> Result<Result<Vec<CodedBand>, CodecError>, ClusterError> {
        let mut all: Vec<Option<CodedBand>> = vec![None; num];
        for (rank, words) in lists.iter().enumerate() {
            let numbers = bands_of(rank, lists.len(), num);
            let wrong = || ClusterError::Job(format!("rank {rank} sent no bands of a frame"));
            match bands_from_words(words, numbers.len()).ok_or_else(wrong)? {
                Ok(bands) => numbers.into_iter().zip(bands).for_each(|(i, band)| all[i] = Some(band)),
                Err(problem) => return Ok(Err(CodecError::Elsewhere { rank, problem })),
            }
        }
        // Own bands are decoded already.
        let numbers = bands_of(self.rank(), lists.len(), num);
        numbers.into_iter().zip(own.into_iter().flatten()).for_each(|(i, band)| all[i] = Some(band));
        Ok(Ok(all.into_iter().flatten().collect()))
    }
}

/// Number of words that have come from other processes.
fn words_of_others(rank: usize, lists: &[Vec<u32>]) -> usize {
    lists.iter().enumerate().filter(|(sender, _)| *sender != rank).map(|(_, words)| words.len()).sum()
}

/// The bands that a process codes. Process 0 codes none where there are enough others.
fn bands_of(rank: usize, num_ranks: usize, num_bands: usize) -> Vec<usize> {
    let coder = |band: usize| match num_ranks > num_bands {
        true => 1 + band * (num_ranks - 1) / num_bands,
        false => band * num_ranks / num_bands,
    };
    (0..num_bands).filter(|band| coder(*band) == rank).collect()
}

/// Coded bands as words, or why there are none.
fn words_from_bands(bands: &Result<Vec<CodedBand>, CodecError>) -> Vec<u32> {
    let mut words = vec![u32::from(bands.is_ok())];
    match bands {
        Ok(bands) => {
            for band in bands {
                push_bytes(&mut words, &band.payload);
                words.push(band.notes.len() as u32);
                words.extend(band.notes.iter().map(|note| note.to_bits()));
            }
        }
        Err(e) => push_bytes(&mut words, e.to_string().as_bytes()),
    }
    words
}

/// Reads the words of [`words_from_bands`] for `num` bands.
fn bands_from_words(words: &[u32], num: usize) -> Option<Result<Vec<CodedBand>, String>> {
    let (is_ok, mut rest) = words.split_first()?;
    if *is_ok == 0 {
        return Some(Err(String::from_utf8_lossy(&take_bytes(&mut rest)?).into_owned()));
    }
    let mut bands = Vec::with_capacity(num);
    for _ in 0..num {
        let payload = take_bytes(&mut rest)?;
        let (num_notes, behind) = rest.split_first()?;
        let (notes, behind) = behind.split_at_checked(*num_notes as usize)?;
        rest = behind;
        let notes = notes.iter().map(|bits| f32::from_bits(*bits)).collect();
        bands.push(CodedBand::of_other(payload, notes));
    }
    rest.is_empty().then_some(Ok(bands))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_band_has_one_coder_and_process_0_rests_where_there_are_enough_others() {
        for num_ranks in 1..20 {
            for num_bands in 1..9 {
                let all: Vec<Vec<usize>> =
                    (0..num_ranks).map(|rank| bands_of(rank, num_ranks, num_bands)).collect();
                assert!(all.concat().into_iter().eq(0..num_bands));
                assert_eq!(all[0].is_empty(), num_ranks > num_bands);
                let most = all.iter().map(Vec::len).max().unwrap();
                assert!(most <= num_bands.div_ceil(num_ranks), "{num_ranks} processes, {num_bands} bands");
            }
        }
    }

    #[test]
    fn bands_arrive_as_they_were_and_cut_words_are_none() {
        let band = |n: u8| CodedBand::of_other(vec![n; 5], vec![f32::from(n); 3]);
        let words = words_from_bands(&Ok(vec![band(1), band(2)]));
        let found = bands_from_words(&words, 2).unwrap().unwrap();
        assert_eq!((&found[1].payload, &found[1].notes), (&vec![2; 5], &vec![2.0; 3]));
        for cut in 0..words.len() {
            assert!(bands_from_words(&words[..cut], 2).is_none(), "{cut} words");
        }
        assert!(bands_from_words(&words, 1).is_none() && bands_from_words(&words, 3).is_none());
        let words = words_from_bands(&Err(CodecError::Abandoned));
        assert_eq!(bands_from_words(&words, 2).unwrap().unwrap_err(), CodecError::Abandoned.to_string());
    }
}

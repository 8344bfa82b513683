//! What all processes do beside frames, and between two slices of the rows of one: slices and values of the volume, and
//! the coding of frames that they have made.

use std::collections::HashMap;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Weak};

use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::{CodecError, Coding, EncodedFrame};
use isinglass_core::kernels::part_slices;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::volume::{
    AskedPoint, AskedPoints, FoundPoint, FoundPoints, PartValues, Slice, SliceSpec, Volume,
};
use serde::{Deserialize, Serialize};

use crate::cluster::{Cluster, OwnRows};
use crate::coding::{CodeJob, Encoded, EncodedHere};
use crate::exchange::ClusterError;
use crate::jobs::{Job, from_words, words_from};
use crate::orders::{Order, Orders};

/// What process 0 asks for beside frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum AsideJob {
    Slice(SliceSpec),
    Values(Vec<AskedPoint>),
    /// The frame of this number, whole.
    Gather(u64),
    /// A frame as bytes.
    Code(CodeJob),
    /// Frames and references that nobody uses any more.
    Forget {
        frames: Vec<u64>,
        references: Vec<u64>,
    },
}

/// The same as it is ordered in process 0.
pub(crate) enum Aside {
    Slice(SliceSpec, SyncSender<Slice>),
    Values(Vec<AskedPoint>, SyncSender<FoundPoints>),
    Gather(Arc<u64>, SyncSender<LayeredFrame>),
    Code(CodeOrder, SyncSender<Result<Encoded, CodecError>>),
}

/// A frame to be coded.
pub(crate) struct CodeOrder {
    frame: Arc<u64>,
    header: FrameHeader,
    coding: Coding,
    is_thinned: bool,
    reference: Option<Arc<Reference>>,
}

/// A layered frame whose rows are in the processes that have made it. They forget it with its last clone.
#[derive(Clone)]
pub struct FrameOfAll {
    pub(crate) orders: Orders,
    pub(crate) number: Arc<u64>,
    pub(crate) header: FrameHeader,
    pub(crate) num_segments: usize,
}

impl std::fmt::Debug for FrameOfAll {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { number, header, num_segments, .. } = self;
        write!(f, "frame {number} of all processes: {num_segments} segments, {header:?}")
    }
}

impl FrameOfAll {
    /// Its header.
    pub fn header(&self) -> &FrameHeader {
        &self.header
    }

    /// Number of segments in all lists.
    pub fn num_segments(&self) -> usize {
        self.num_segments
    }

    /// The frame; `None` if the processes have ended.
    pub fn gather(&self) -> Option<LayeredFrame> {
        self.orders.aside(|reply| Aside::Gather(self.number.clone(), reply))
    }

    /// The frame as bytes, under a header with other numbers. Each process codes some rows; the bytes are those of the
    /// frame as a whole. A thinned frame has fewer segments: see [`LayeredFrame::thinned`]. The reference must be one
    /// that this has returned.
    ///
    /// # Errors
    /// See [`Coding::encode_while`]. Without processes the frame is abandoned.
    pub fn encode(
        &self,
        header: &FrameHeader,
        coding: Coding,
        is_thinned: bool,
        reference: Option<&Arc<Reference>>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        let (frame, reference) = (self.number.clone(), reference.cloned());
        let order = CodeOrder { frame, header: *header, coding, is_thinned, reference };
        let made = self.orders.aside(|reply| Aside::Code(order, reply));
        made.unwrap_or(Err(CodecError::Abandoned))
    }
}

impl Orders {
    /// A slice of the whole volume; `None` if the processes have ended.
    pub fn slice(&self, spec: SliceSpec) -> Option<Slice> {
        self.aside(|reply| Aside::Slice(spec, reply))
    }

    /// What the whole volume has at points; `None` if the processes have ended.
    pub fn values(&self, asked: AskedPoints) -> Option<FoundPoints> {
        self.aside(|reply| Aside::Values(asked.0, reply))
    }

    fn aside<T>(&self, order: impl FnOnce(SyncSender<T>) -> Aside) -> Option<T> {
        let (reply, answer) = sync_channel(1);
        self.send(Order::Aside(order(reply)))?;
        answer.recv().ok()
    }
}

/// What a process keeps of frames.
#[derive(Default)]
pub(crate) struct Shelf {
    pub(crate) frames: HashMap<u64, OwnRows>,
    references: HashMap<u64, Arc<Reference>>,
}

impl Shelf {
    fn frame(&self, number: u64) -> Result<&OwnRows, ClusterError> {
        self.frames.get(&number).ok_or_else(|| ClusterError::Job(format!("frame {number}")))
    }

    fn forget(&mut self, frames: &[u64], references: &[u64]) {
        frames.iter().for_each(|number| drop(self.frames.remove(number)));
        references.iter().for_each(|number| drop(self.references.remove(number)));
    }
}

/// The numbers under which process 0 has things kept, and who has them.
#[derive(Default)]
pub(crate) struct Numbers {
    last: u64,
    frames: Vec<(u64, Weak<u64>)>,
    references: Vec<(u64, Weak<Reference>)>,
}

impl Numbers {
    /// A number that nothing had before.
    pub(crate) fn next(&mut self) -> u64 {
        self.last += 1;
        self.last
    }

    /// Notes a frame that is kept.
    pub(crate) fn note_frame(&mut self, number: u64) -> Arc<u64> {
        let held = Arc::new(number);
        self.frames.push((number, Arc::downgrade(&held)));
        held
    }

    /// The number of a reference that all keep.
    fn reference(&self, reference: &Arc<Reference>) -> Option<u64> {
        let found = self.references.iter().find(|(_, known)| known.as_ptr() == Arc::as_ptr(reference));
        found.map(|(number, _)| *number)
    }

    /// The numbers of frames and of references that nobody uses any more.
    fn take_dropped(&mut self) -> [Vec<u64>; 2] {
        let dropped = self.frames.extract_if(.., |(_, held)| held.strong_count() == 0);
        let frames = dropped.map(|(number, _)| number).collect();
        // The own shelf has one.
        let dropped = self.references.extract_if(.., |(_, held)| held.strong_count() <= 1);
        let references = dropped.map(|(number, _)| number).collect();
        [frames, references]
    }
}

impl Cluster<'_> {
    /// Tells the others what all do next. Those in a frame wait for it, others may sleep.
    pub(crate) fn tell(&self, job: &Job, is_in_frame: bool) -> Result<(), ClusterError> {
        let words = words_from(job)?;
        match is_in_frame {
            true => self.exchange().broadcast(words)?,
            false => self.exchange().broadcast_some_day(words)?,
        };
        Ok(())
    }

    /// What process 0 tells, in another one.
    pub(crate) fn told(&self, is_in_frame: bool) -> Result<Job, ClusterError> {
        let words = match is_in_frame {
            true => self.exchange().broadcast(Vec::new())?,
            false => self.exchange().broadcast_some_day(Vec::new())?,
        };
        from_words(&words)
    }

    /// Tells all processes to forget what nobody uses any more. In process 0.
    pub(crate) fn tidy(
        &self,
        numbers: &mut Numbers,
        shelf: &mut Shelf,
        is_in_frame: bool,
    ) -> Result<(), ClusterError> {
        let [frames, references] = numbers.take_dropped();
        if !frames.is_empty() || !references.is_empty() {
            shelf.forget(&frames, &references);
            self.tell(&Job::Aside(AsideJob::Forget { frames, references }), is_in_frame)?;
        }
        Ok(())
    }

    /// Does what was ordered beside frames, together with the others. In process 0.
    pub(crate) fn order_aside(
        &self,
        order: Aside,
        volume: &Volume,
        (numbers, shelf): (&mut Numbers, &mut Shelf),
        is_in_frame: bool,
    ) -> Result<(), ClusterError> {
        let tell = |job| self.tell(&Job::Aside(job), is_in_frame);
        // Who ordered something may have left.
        match order {
            Aside::Slice(spec, reply) => {
                tell(AsideJob::Slice(spec))?;
                if let Some(slice) = self.slice(volume, &spec)? {
                    let _ = reply.send(slice);
                }
            }
            Aside::Values(points, reply) => {
                tell(AsideJob::Values(points.clone()))?;
                if let Some(values) = self.values(volume, points)? {
                    let _ = reply.send(values);
                }
            }
            Aside::Gather(frame, reply) => {
                tell(AsideJob::Gather(*frame))?;
                if let Some(whole) = self.gather(shelf.frame(*frame)?)? {
                    let _ = reply.send(whole);
                }
            }
            Aside::Code(CodeOrder { frame, header, coding, is_thinned, reference }, reply) => {
                self.tidy(numbers, shelf, is_in_frame)?;
                let named = reference.as_ref().map(|held| {
                    let missing = CodecError::Reference { frame: header.frame, reference: held.frame() };
                    numbers.reference(held).ok_or(missing)
                });
                let named = match named.transpose() {
                    Ok(named) => named,
                    Err(missing) => {
                        let _ = reply.send(Err(missing));
                        return Ok(());
                    }
                };
                let number = numbers.next();
                let job = CodeJob::new(*frame, &header, coding, is_thinned, (named, number));
                tell(AsideJob::Code(job))?;
                let made = self.code_kept(&job, shelf)?;
                if let Ok((_, Some(reference))) = &made {
                    numbers.references.push((number, Arc::downgrade(reference)));
                }
                let _ = reply.send(made.and_then(|(encoded, reference)| {
                    Ok((encoded.ok_or(CodecError::Incomplete { found: 0, expected: 1 })?, reference))
                }));
            }
        }
        Ok(())
    }

    /// Does what process 0 asks for beside frames. In other processes.
    pub(crate) fn do_aside(
        &self,
        job: AsideJob,
        volume: &Volume,
        shelf: &mut Shelf,
    ) -> Result<(), ClusterError> {
        match job {
            AsideJob::Slice(spec) => self.slice(volume, &spec).map(drop),
            AsideJob::Values(points) => self.values(volume, points).map(drop),
            AsideJob::Gather(frame) => self.gather(shelf.frame(frame)?).map(drop),
            AsideJob::Code(job) => self.code_kept(&job, shelf).map(drop),
            AsideJob::Forget { frames, references } => {
                shelf.forget(&frames, &references);
                Ok(())
            }
        }
    }

    /// Waits until process 0 says whether a frame goes on, and does what it asks for until then. In other processes.
    pub(crate) fn goes_on(&self, volume: &Volume, shelf: &mut Shelf) -> Result<bool, ClusterError> {
        loop {
            match self.told(true)? {
                Job::GoOn(goes_on) => return Ok(goes_on),
                Job::Aside(job) => self.do_aside(job, volume, shelf)?,
                other => return Err(ClusterError::Job(format!("{other:?} in a frame"))),
            }
        }
    }

    fn code_kept(&self, job: &CodeJob, shelf: &mut Shelf) -> Result<EncodedHere, ClusterError> {
        let reference = job.reference.map(|number| {
            let found = shelf.references.get(&number).cloned();
            found.ok_or_else(|| ClusterError::Job(format!("reference {number}")))
        });
        let made = self.code(shelf.frame(job.frame)?, job, reference.transpose()?.as_deref())?;
        if let Ok((_, Some(reference))) = &made {
            shelf.references.insert(job.number, reference.clone());
        }
        Ok(made)
    }

    /// A slice of the whole volume, in process 0.
    fn slice(&self, volume: &Volume, spec: &SliceSpec) -> Result<Option<Slice>, ClusterError> {
        let lists = self.exchange().gather(part_slices::cut(volume, self.own(), spec))?;
        let num = self.exchange().size();
        let unite = |lists: Vec<_>| part_slices::slice_of_parts(volume, num, spec, &lists);
        Ok(lists.map(unite).transpose()?)
    }

    /// What the whole volume has at points, in process 0.
    fn values(&self, volume: &Volume, points: Vec<AskedPoint>) -> Result<Option<FoundPoints>, ClusterError> {
        let asked = AskedPoints(points);
        let found = asked.found_in(&mut PartValues { volume, own: *self.own() });
        let Some(lists) = self.exchange().gather(words_from(&found)?)? else { return Ok(None) };
        let parts = lists.iter().map(|words| from_words::<Vec<Option<FoundPoint>>>(words));
        Ok(Some(FoundPoints::of_parts(asked.0.len(), parts.collect::<Result<Vec<_>, _>>()?)))
    }
}

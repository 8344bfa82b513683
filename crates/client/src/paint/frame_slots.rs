//! Which frame is in which slot of the GPU. Each frame is uploaded once.

use std::sync::{Arc, Weak};

/// At most `NUM` frames. A slot is free when nobody holds its frame any more. The first free slot is used, so there
/// are hardly more slots in use than frames that are kept.
pub(crate) struct FrameSlots<T, const NUM: usize> {
    slots: Vec<Slot<T>>,
    refreshes: u64,
}

struct Slot<T> {
    frame: Weak<T>,
    /// Why the upload failed. It would fail again at every refresh.
    refused: Option<String>,
    /// The last refresh that needed the slot.
    needed_at: u64,
}

impl<T, const NUM: usize> Default for FrameSlots<T, NUM> {
    fn default() -> Self {
        Self { slots: Vec::new(), refreshes: 0 }
    }
}

impl<T, const NUM: usize> FrameSlots<T, NUM> {
    /// The slots of the frames of a refresh, in their order. `upload` fills a slot with a frame that is not there
    /// yet. Frames beyond `NUM` are refused.
    pub(crate) fn refresh<E: ToString>(
        &mut self,
        frames: &[&Arc<T>],
        mut upload: impl FnMut(usize, &T) -> Result<(), E>,
    ) -> Vec<Result<usize, String>> {
        self.refreshes += 1;
        for slot in &mut self.slots {
            if frames.iter().any(|frame| slot.holds(frame)) {
                slot.needed_at = self.refreshes;
            }
        }
        let slot_of = |frame: &&Arc<T>| -> Result<usize, String> {
            if let Some(n) = self.slots.iter().position(|slot| slot.holds(frame)) {
                return self.slots[n].refused.clone().map_or(Ok(n), Err);
            }
            let n = self.free_slot().ok_or("no slot is free")?;
            let refused = upload(n, frame).err().map(|e| e.to_string());
            let slot = Slot { frame: Arc::downgrade(frame), refused, needed_at: self.refreshes };
            let result = slot.refused.clone().map_or(Ok(n), Err);
            match self.slots.get_mut(n) {
                Some(former) => *former = slot,
                None => self.slots.push(slot),
            }
            result
        };
        frames.iter().map(slot_of).collect()
    }

    /// The first slot that nobody needs, or else the one that was unused for longest.
    fn free_slot(&self) -> Option<usize> {
        let is_dead = |slot: &Slot<T>| slot.frame.strong_count() == 0 && slot.needed_at < self.refreshes;
        let dead = self.slots.iter().position(is_dead);
        let unused = (self.slots.len() < NUM).then_some(self.slots.len());
        let oldest = || {
            let idle = self.slots.iter().enumerate().filter(|(_, slot)| slot.needed_at < self.refreshes);
            idle.min_by_key(|(_, slot)| slot.needed_at).map(|(n, _)| n)
        };
        dead.or(unused).or_else(oldest)
    }
}

impl<T> Slot<T> {
    fn holds(&self, frame: &Arc<T>) -> bool {
        std::ptr::eq(self.frame.as_ptr(), Arc::as_ptr(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four slots and what was uploaded to them.
    #[derive(Default)]
    struct Gpu {
        slots: FrameSlots<u32, 4>,
        content: [u32; 4],
        num_uploads: usize,
    }

    impl Gpu {
        fn show(&mut self, frames: &[&Arc<u32>]) -> Vec<Result<usize, String>> {
            let Self { slots, content, num_uploads } = self;
            let places = slots.refresh(frames, |slot, frame| {
                *num_uploads += 1;
                if *frame == 13 {
                    return Err("13");
                }
                content[slot] = *frame;
                Ok(())
            });
            for (place, frame) in places.iter().zip(frames) {
                assert!(place.as_ref().is_ok_and(|slot| self.content[*slot] == ***frame) || ***frame == 13);
            }
            places
        }
    }

    #[test]
    fn each_frame_is_uploaded_once_and_few_slots_are_used() {
        let mut gpu = Gpu::default();
        let (first, second) = (Arc::new(1), Arc::new(2));
        for _ in 0..3 {
            assert_eq!(gpu.show(&[&first]), [Ok(0)]);
            assert_eq!(gpu.show(&[&second, &first]), [Ok(1), Ok(0)]);
        }
        assert_eq!(gpu.num_uploads, 2);
        // A stream of frames that nobody keeps takes one slot more, and leaves the kept ones alone.
        for number in 100..200 {
            assert_eq!(gpu.show(&[&Arc::new(number), &second]), [Ok(2), Ok(1)]);
        }
        assert_eq!(gpu.show(&[&first]), [Ok(0)]);
        assert_eq!(gpu.num_uploads, 102);
    }

    #[test]
    fn with_more_kept_than_slots_the_longest_not_needed_makes_room() {
        let mut gpu = Gpu::default();
        let kept: Vec<Arc<u32>> = (0..6).map(Arc::new).collect();
        for frame in &kept {
            gpu.show(&[frame]);
        }
        // 2 to 5 are there. What a refresh needs is never driven out by another of its frames.
        assert_eq!(gpu.num_uploads, 6);
        gpu.show(&[&kept[0], &kept[2], &kept[3], &kept[4]]);
        assert_eq!(gpu.num_uploads, 7);
        let places = gpu.slots.refresh(&kept.iter().collect::<Vec<_>>(), |_, _| Ok::<(), String>(()));
        assert_eq!(places.iter().filter(|place| place.is_err()).count(), 2);
    }

    #[test]
    fn a_frame_that_is_refused_is_not_tried_again() {
        let mut gpu = Gpu::default();
        let (good, bad) = (Arc::new(1), Arc::new(13));
        for _ in 0..3 {
            assert_eq!(gpu.show(&[&bad, &good]), [Err("13".to_owned()), Ok(1)]);
        }
        assert_eq!(gpu.num_uploads, 2);
    }
}

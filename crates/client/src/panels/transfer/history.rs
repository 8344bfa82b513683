//! Undo and redo.

/// States before and after the present one, which the owner holds.
#[derive(Clone, Debug)]
pub(crate) struct History<T> {
    past: Vec<T>,
    future: Vec<T>,
}

impl<T> Default for History<T> {
    fn default() -> Self {
        Self { past: Vec::new(), future: Vec::new() }
    }
}

impl<T> History<T> {
    /// The present state replaces `before`.
    pub(crate) fn note(&mut self, before: T) {
        if self.past.len() == MAX_STEPS {
            self.past.remove(0);
        }
        self.past.push(before);
        self.future.clear();
    }

    /// The state before `present`, if there is one.
    pub(crate) fn undo(&mut self, present: T) -> Option<T> {
        let before = self.past.pop()?;
        self.future.push(present);
        Some(before)
    }

    /// The state that [`History::undo`] left, if nothing has changed since.
    pub(crate) fn redo(&mut self, present: T) -> Option<T> {
        let after = self.future.pop()?;
        self.past.push(present);
        Some(after)
    }

    pub(crate) fn has(&self) -> (bool, bool) {
        (!self.past.is_empty(), !self.future.is_empty())
    }
}

/// A transfer function takes a few hundred bytes.
const MAX_STEPS: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undo_and_redo_walk_the_same_way_back_and_forth() {
        let mut history = History::default();
        let mut present = 0;
        for next in 1..=3 {
            history.note(present);
            present = next;
        }
        for expected in [2, 1, 0] {
            present = history.undo(present).unwrap();
            assert_eq!(present, expected);
        }
        assert_eq!((history.undo(present), history.has()), (None, (false, true)));
        for expected in [1, 2] {
            present = history.redo(present).unwrap();
            assert_eq!(present, expected);
        }
        history.note(present);
        present = 9;
        assert_eq!((history.redo(present), history.undo(present)), (None, Some(2)));
        (0..1000).for_each(|i| history.note(i));
        assert_eq!(history.past.len(), MAX_STEPS);
    }
}

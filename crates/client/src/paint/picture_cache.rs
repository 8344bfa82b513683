//! Whether the picture of a refresh has to be cast. A window is drawn anew for many reasons, a pointer over a button among
//! them; a picture that has not changed is cast once more, into a texture, and copied from there as long as it stays.
//! Pictures that move are cast straight into the window, which saves the copy.

/// What is to be done for a refresh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// Cast into the window.
    Straight,
    /// Cast into the texture, and copy from there.
    Apart,
    /// Copy what the texture holds.
    Again,
}

impl Way {
    /// Whether the window gets a copy of the texture.
    pub(crate) fn is_copied(self) -> bool {
        self != Self::Straight
    }
}

/// The picture of the refresh before, by all that it is made of.
#[derive(Debug)]
pub(crate) struct Stills<T> {
    last: Option<T>,
    is_apart: bool,
}

impl<T> Default for Stills<T> {
    fn default() -> Self {
        Self { last: None, is_apart: false }
    }
}

impl<T: PartialEq> Stills<T> {
    /// The way of the next picture: `must` says that it has to go by the texture, `may` that it can.
    pub(crate) fn next(&mut self, picture: T, must: bool, may: bool) -> Way {
        let is_same = self.last.as_ref() == Some(&picture);
        let way = match is_same {
            true if self.is_apart && (must || may) => Way::Again,
            _ if must || (is_same && may) => Way::Apart,
            _ => Way::Straight,
        };
        self.is_apart = way.is_copied();
        self.last = Some(picture);
        way
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_still_is_cast_once_more_and_then_copied() {
        let mut stills = Stills::default();
        let mut next = |picture| stills.next(picture, false, true);
        assert_eq!([1, 2, 3].map(&mut next), [Way::Straight; 3]);
        assert_eq!([3, 3, 3].map(&mut next), [Way::Apart, Way::Again, Way::Again]);
        assert_eq!([4, 4, 4, 3].map(&mut next), [Way::Straight, Way::Apart, Way::Again, Way::Straight]);
    }

    #[test]
    fn smaller_pictures_are_always_cast_apart_and_only_once() {
        let mut stills = Stills::default();
        let mut next = |picture| stills.next(picture, true, false);
        assert_eq!([1, 2, 2, 3].map(&mut next), [Way::Apart, Way::Apart, Way::Again, Way::Apart]);
        // The same in full is another picture.
        assert_eq!(stills.next(4, false, true), Way::Straight);
    }

    #[test]
    fn what_a_texture_cannot_hold_is_cast_each_time() {
        let mut stills = Stills::default();
        assert!((0..3).all(|_| stills.next(1, false, false) == Way::Straight));
        assert_eq!(
            [true, true, false].map(|may| stills.next(1, false, may)),
            [Way::Apart, Way::Again, Way::Straight]
        );
    }
}

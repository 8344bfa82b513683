//! Whether the picture of a refresh has to be cast. A window is drawn anew for many reasons, such as a pointer over a
//! button. A picture that has not changed is cast once more, into a texture, and copied from there while it stays the
//! same. A picture that moves is cast straight into the window, which saves the copy.

/// How the picture of a refresh is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DrawPath {
    /// Cast into the window.
    Direct,
    /// Cast into the texture, and copied from there.
    IntoTexture,
    /// Copied from what the texture holds.
    FromTexture,
}

/// The picture of the refresh before, by all that it is made of.
#[derive(Debug)]
pub(crate) struct PictureCache<T> {
    last: Option<T>,
    is_in_texture: bool,
}

impl<T> Default for PictureCache<T> {
    fn default() -> Self {
        Self { last: None, is_in_texture: false }
    }
}

impl<T: PartialEq> PictureCache<T> {
    /// The path of the next picture. `must`: it has to go by the texture. `may`: it can.
    pub(crate) fn next(&mut self, picture: T, must: bool, may: bool) -> DrawPath {
        let is_same = self.last.as_ref() == Some(&picture);
        let path = match is_same {
            true if self.is_in_texture && (must || may) => DrawPath::FromTexture,
            _ if must || (is_same && may) => DrawPath::IntoTexture,
            _ => DrawPath::Direct,
        };
        self.is_in_texture = path != DrawPath::Direct;
        self.last = Some(picture);
        path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_still_is_cast_once_more_and_then_copied() {
        let mut cache = PictureCache::default();
        let mut next = |picture| cache.next(picture, false, true);
        assert_eq!([1, 2, 3].map(&mut next), [DrawPath::Direct; 3]);
        assert_eq!(
            [3, 3, 3].map(&mut next),
            [DrawPath::IntoTexture, DrawPath::FromTexture, DrawPath::FromTexture]
        );
        assert_eq!(
            [4, 4, 4, 3].map(&mut next),
            [DrawPath::Direct, DrawPath::IntoTexture, DrawPath::FromTexture, DrawPath::Direct]
        );
    }

    #[test]
    fn smaller_pictures_are_always_cast_apart_and_only_once() {
        let mut cache = PictureCache::default();
        let mut next = |picture| cache.next(picture, true, false);
        assert_eq!(
            [1, 2, 2, 3].map(&mut next),
            [DrawPath::IntoTexture, DrawPath::IntoTexture, DrawPath::FromTexture, DrawPath::IntoTexture]
        );
        // The same in full is another picture.
        assert_eq!(cache.next(4, false, true), DrawPath::Direct);
    }

    #[test]
    fn what_a_texture_cannot_hold_is_cast_each_time() {
        let mut cache = PictureCache::default();
        assert!((0..3).all(|_| cache.next(1, false, false) == DrawPath::Direct));
        assert_eq!(
            [true, true, false].map(|may| cache.next(1, false, may)),
            [DrawPath::IntoTexture, DrawPath::FromTexture, DrawPath::Direct]
        );
    }
}

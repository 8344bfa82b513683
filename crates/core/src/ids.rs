//! Newtypes for every id that crosses a module or the wire.

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty)) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $name(pub $inner);

        impl $name {
            /// The id after this one, wrapping at the end of the range.
            pub fn next(self) -> Self {
                Self(self.0.wrapping_add(1))
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

id!(
    /// One layered frame, numbered by the server in the order of generation.
    FrameId(u32)
);
id!(
    /// One camera pose, numbered by the client; 0 means "no pose was asked for".
    PoseId(u32)
);
id!(
    /// Counts the changes of look (transfer function and shading); a frame names its version.
    LookVersion(u32)
);
id!(
    /// One question for the value at a point, numbered by the client.
    ProbeId(u32)
);
id!(
    /// One picture to keep, numbered by the client.
    ScreenshotId(u32)
);
id!(
    /// One slice through the volume, numbered by the client.
    SliceId(u32)
);
id!(
    /// Position of a chunk within its frame: 0 is sent first.
    ChunkIndex(u16)
);
id!(
    /// One reading of another part of the file, numbered by the server.
    LoadId(u32)
);

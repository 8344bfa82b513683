//! Errors of a GPU, and their translation from wgpu's error scopes.

/// Why the GPU failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// There is no driver, or it offers no device.
    #[error("no usable GPU: {0}; install a Vulkan, Metal or DirectX 12 driver, or use the cpu backend")]
    NoAdapter(String),
    /// A device was found but did not open.
    #[error("device '{adapter}' cannot be opened: {reason}")]
    Open {
        /// Name of the device.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// The device has too little memory for the pages of a view.
    #[error("the device has memory for {most} pages of the volume at once")]
    Pages {
        /// Pages that it has memory for.
        most: usize,
    },
    /// There are fewer devices of a kind than wanted.
    #[error("found {found} {what}, expected {wanted}")]
    TooFew {
        /// Their kind, in the plural.
        what: String,
        /// Devices of this kind that opened.
        found: usize,
        /// Devices that somebody asked for.
        wanted: usize,
    },
    /// Something exceeds a limit of the device.
    #[error("{what} needs {needed}, the device takes at most {limit}")]
    TooLarge {
        /// Its name, with the unit of the numbers.
        what: &'static str,
        /// Size needed.
        needed: u64,
        /// Limit of the device.
        limit: u64,
    },
    /// The device is out of memory.
    #[error("GPU memory exhausted while {0}")]
    OutOfMemory(&'static str),
    /// The device is lost: driver reset, unplugged, or stopped by a watchdog.
    #[error("GPU lost while {what}: {reason}")]
    Lost {
        /// The operation.
        what: &'static str,
        /// What the driver said.
        reason: String,
    },
    /// wgpu or the driver refused a command or a shader.
    #[error("GPU failed while {what}: {reason}")]
    Failed {
        /// The operation.
        what: &'static str,
        /// The message.
        reason: String,
    },
    /// No picture can be made for this camera.
    #[error("camera is not valid: expected finite numbers, near < far and sides of 1 to {max}", max = isinglass_core::camera::MAX_SIDE)]
    Camera,
    /// A layered frame is invalid.
    #[error("layered frame is not valid: {0}")]
    Frame(String),
}

impl GpuError {
    /// Whether the CPU may take over: the device failed by itself or is too small.
    pub fn asks_for_cpu(&self) -> bool {
        self.is_lost() || matches!(self, Self::TooLarge { .. })
    }

    /// Whether the device's data may be lost, so that another device must be tried. After other errors the device
    /// goes on as before.
    pub fn is_lost(&self) -> bool {
        match self {
            Self::OutOfMemory(_) | Self::Lost { .. } | Self::Failed { .. } => true,
            Self::NoAdapter(_)
            | Self::Open { .. }
            | Self::TooFew { .. }
            | Self::TooLarge { .. }
            | Self::Pages { .. }
            | Self::Camera
            | Self::Frame(_) => false,
        }
    }
}

/// Runs `body` and turns what wgpu reports meanwhile on this thread into an error. The first cause wins: without
/// memory, everything after it is invalid too.
pub(crate) fn scoped<T>(
    device: &wgpu::Device,
    what: &'static str,
    body: impl FnOnce() -> Result<T, GpuError>,
) -> Result<T, GpuError> {
    use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
    let validation = device.push_error_scope(Validation);
    let internal = device.push_error_scope(Internal);
    let memory = device.push_error_scope(OutOfMemory);
    let result = body();
    let memory = pollster::block_on(memory.pop());
    let internal = pollster::block_on(internal.pop());
    let validation = pollster::block_on(validation.pop());
    match memory.or(internal).or(validation) {
        None => result,
        Some(error) => Err(from_wgpu(what, &error)),
    }
}

pub(crate) fn from_wgpu(what: &'static str, error: &wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory(what),
        error => GpuError::Failed { what, reason: one_line(&error.to_string()) },
    }
}

/// Joins a report of several lines.
pub(crate) fn one_line(report: &str) -> String {
    report.split_whitespace().collect::<Vec<_>>().join(" ")
}

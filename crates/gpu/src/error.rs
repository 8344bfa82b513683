//! What can go wrong on a GPU, and how wgpu's error scopes become [`GpuError`].

/// Why the GPU did not do it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// There is no driver, or it offers no device.
    #[error("no usable GPU: {0}; install a Vulkan, Metal or DirectX 12 driver, or use the cpu backend")]
    NoAdapter(String),
    /// A device was found and refused to open.
    #[error("device '{adapter}' cannot be opened: {reason}")]
    Open {
        /// Name of the device.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// Something is larger than the device takes.
    #[error("{what} needs {needed}, the device takes at most {limit}")]
    TooLarge {
        /// What, with the unit of the numbers.
        what: &'static str,
        /// Size needed.
        needed: u64,
        /// Limit of the device.
        limit: u64,
    },
    /// The device has no memory left.
    #[error("GPU memory exhausted while {0}")]
    OutOfMemory(&'static str),
    /// The device is gone: driver reset, unplugged, or stopped for taking too long.
    #[error("GPU lost while {what}: {reason}")]
    Lost {
        /// What was being done.
        what: &'static str,
        /// What the driver said.
        reason: String,
    },
    /// wgpu or the driver refused a command or a shader.
    #[error("GPU failed while {what}: {reason}")]
    Failed {
        /// What was being done.
        what: &'static str,
        /// What was said.
        reason: String,
    },
    /// A camera that no picture can be made for.
    #[error("camera is not valid: expected finite numbers, near < far and sides of 1 to {max}", max = isinglass_core::camera::MAX_SIDE)]
    Camera,
    /// A layered frame that breaks its promises.
    #[error("layered frame is not valid: {0}")]
    Frame(String),
}

impl GpuError {
    /// Whether the CPU may do what the device could not: it fails by itself, or it is too small for it.
    pub fn asks_for_cpu(&self) -> bool {
        self.is_lost() || matches!(self, Self::TooLarge { .. })
    }

    /// Whether what is on the device may be of no use any more, so that the same is to be tried elsewhere. After the others the device
    /// goes on as before.
    pub fn is_lost(&self) -> bool {
        match self {
            Self::OutOfMemory(_) | Self::Lost { .. } | Self::Failed { .. } => true,
            Self::NoAdapter(_)
            | Self::Open { .. }
            | Self::TooLarge { .. }
            | Self::Camera
            | Self::Frame(_) => false,
        }
    }
}

/// Runs `body` and turns what wgpu reports on this thread meanwhile into an error. The first cause comes first: without
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

/// The error as ours.
pub(crate) fn from_wgpu(what: &'static str, error: &wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory(what),
        error => GpuError::Failed { what, reason: one_line(&error.to_string()) },
    }
}

/// A report of several lines as one.
pub(crate) fn one_line(report: &str) -> String {
    report.split_whitespace().collect::<Vec<_>>().join(" ")
}

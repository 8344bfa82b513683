//! The devices of a server: one backend, or several GPUs of one kind.

use std::str::FromStr;

use isinglass_gpu::{Gpu, GpuError};

use crate::{Backend, BackendChoice};

/// The user's choice of how many GPUs are used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GpuCount {
    /// The best one, and all others of its kind.
    #[default]
    All,
    /// So many of the best kind, at least 1. A software device counts as often as wanted.
    Number(usize),
}

impl std::fmt::Display for GpuCount {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::Number(1) => f.write_str("one"),
            Self::Number(number) => write!(f, "{number}"),
        }
    }
}

impl FromStr for GpuCount {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        match s {
            "all" => Ok(Self::All),
            "one" => Ok(Self::Number(1)),
            number => {
                let number = number.parse().ok().filter(|n| (1..=MAX_GPUS).contains(n));
                number.map(Self::Number).ok_or_else(|| format!("expected all, one, or 1 to {MAX_GPUS}"))
            }
        }
    }
}

/// Where a server's kernels run, at least one place. A viewer's frames are made by one of them.
#[derive(Clone)]
pub struct Devices(Vec<Backend>);

impl From<Backend> for Devices {
    fn from(backend: Backend) -> Self {
        Self(vec![backend])
    }
}

impl Devices {
    /// Opens the chosen backend: of GPUs, as many as there should be.
    ///
    /// # Errors
    /// If there is no GPU where one is chosen, or fewer than wanted. The CPU is one place, so it is never several.
    pub fn open(choice: BackendChoice, gpus: GpuCount) -> Result<Self, GpuError> {
        let wanted = match gpus {
            GpuCount::Number(number) if number > 1 => Some(number),
            GpuCount::Number(_) => return Ok(Backend::open(choice)?.into()),
            GpuCount::All => None,
        };
        match choice {
            BackendChoice::Gpu => Ok(Self::of_gpus(Gpu::open_alike(wanted)?)),
            BackendChoice::Auto => match Backend::open(choice)? {
                Backend::Gpu(_) => Ok(Self::of_gpus(Gpu::open_alike(wanted)?)),
                cpu => Self::of_cpu(cpu, wanted),
            },
            BackendChoice::Cpu => Self::of_cpu(Backend::Cpu, wanted),
        }
    }

    fn of_cpu(cpu: Backend, wanted: Option<usize>) -> Result<Self, GpuError> {
        match wanted {
            Some(wanted) => Err(GpuError::TooFew { what: "GPUs in hardware".into(), found: 0, wanted }),
            None => Ok(cpu.into()),
        }
    }

    /// These GPUs, or the CPU if there are none.
    pub fn of_gpus(gpus: Vec<Gpu>) -> Self {
        if gpus.is_empty() { Backend::Cpu.into() } else { Self(gpus.into_iter().map(Backend::Gpu).collect()) }
    }

    /// Each of them.
    pub fn each(&self) -> &[Backend] {
        &self.0
    }

    /// That of one place; for several GPUs of one kind their number and the kind.
    pub fn description(&self) -> String {
        match &self.0[..] {
            [Backend::Gpu(gpu), _, ..] => format!("{} gpus: {}", self.0.len(), gpu.info()),
            all => all.first().map_or_else(String::new, Backend::description),
        }
    }
}

/// Most GPUs of one server.
const MAX_GPUS: usize = 64;

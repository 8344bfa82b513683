//! Which devices there are, and the ones to open.

use crate::device::{Gpu, GpuInfo};
use crate::error::GpuError;

impl Gpu {
    /// Opens the best working device: discrete before integrated before software. Without any this is an error.
    pub fn open() -> Result<Self, GpuError> {
        Ok(best(&adapters()?)?.1)
    }

    /// Opens the best working device and all others of its kind, or `wanted` of them. A software device counts once, or
    /// as often as wanted: each time it opens as a device of its own.
    ///
    /// # Errors
    /// If there is none, or fewer than wanted.
    pub fn open_alike(wanted: Option<usize>) -> Result<Vec<Self>, GpuError> {
        let adapters = adapters()?;
        let (at, first) = best(&adapters)?;
        let is_software = first.info().is_software;
        let most = wanted.unwrap_or(if is_software { 1 } else { usize::MAX }).max(1);
        let mut devices = vec![first];
        if is_software {
            while devices.len() < most {
                devices.push(Self::open_adapter(&adapters[at])?);
            }
        }
        for adapter in others_alike(&adapters, at) {
            if devices.len() >= most {
                break;
            }
            match Self::open_adapter(adapter) {
                Ok(device) => devices.push(device),
                Err(e) => tracing::info!("{e}"),
            }
        }
        match wanted {
            Some(wanted) if devices.len() < wanted => {
                let what = format!("GPUs of the kind '{}'", devices[0].info().name);
                Err(GpuError::TooFew { what, found: devices.len(), wanted })
            }
            _ => Ok(devices),
        }
    }

    /// Opens one of the best working devices and all others of its kind: each in turn, from 0.
    ///
    /// # Errors
    /// If there is none.
    pub fn open_in_turn(turn: usize) -> Result<Self, GpuError> {
        let adapters = adapters()?;
        let (at, first) = best(&adapters)?;
        let others = others_alike(&adapters, at);
        match turn % (1 + others.len()) {
            0 => Ok(first),
            turn => {
                drop(first);
                Self::open_adapter(others[turn - 1])
            }
        }
    }

    /// Opens the same device again, after it was lost.
    ///
    /// # Errors
    /// If it is no longer there.
    pub fn open_again(&self) -> Result<Self, GpuError> {
        let own = self.info();
        let adapters = adapters()?;
        let adapter = adapters.iter().find(|adapter| info_of(adapter) == *own);
        adapter
            .map_or_else(|| Err(GpuError::NoAdapter(format!("'{}' has gone", own.name))), Self::open_adapter)
    }
}

impl GpuInfo {
    /// Whether both are devices of one kind.
    fn is_alike(&self, other: &Self) -> bool {
        Self { bus: other.bus.clone(), ..self.clone() } == *other
    }
}

/// Facts about an adapter.
pub(crate) fn info_of(adapter: &wgpu::Adapter) -> GpuInfo {
    let info = adapter.get_info();
    GpuInfo {
        name: info.name,
        backend: info.backend.to_string(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        bus: info.device_pci_bus_id,
        is_software: info.device_type == wgpu::DeviceType::Cpu,
    }
}

/// The adapters behind the one at a place that are other devices of its kind. Each software device is the same.
fn others_alike(adapters: &[wgpu::Adapter], at: usize) -> Vec<&wgpu::Adapter> {
    let first = info_of(&adapters[at]);
    let mut buses = vec![first.bus.clone()];
    let mut is_another = |adapter: &&wgpu::Adapter| {
        let found = info_of(adapter);
        // Two drivers may offer the same device.
        let is_known = !found.bus.is_empty() && buses.contains(&found.bus);
        let is_another = !is_known && !found.is_software && first.is_alike(&found);
        buses.extend(is_another.then_some(found.bus));
        is_another
    };
    adapters[at + 1..].iter().filter(|adapter| is_another(adapter)).collect()
}

/// The first adapter that opens, and its device.
fn best(adapters: &[wgpu::Adapter]) -> Result<(usize, Gpu), GpuError> {
    let mut problem = None;
    for (at, adapter) in adapters.iter().enumerate() {
        match Gpu::open_adapter(adapter) {
            Ok(gpu) => return Ok((at, gpu)),
            Err(e) => {
                tracing::info!("{e}");
                // The error of the best device is the one to report.
                problem.get_or_insert(e);
            }
        }
    }
    Err(problem.unwrap_or_else(|| GpuError::NoAdapter("no driver offers a device".into())))
}

/// Adapters with everything that kernels need: discrete, integrated, others, then software. At least one.
fn adapters() -> Result<Vec<wgpu::Adapter>, GpuError> {
    let backends = wgpu::Backends::PRIMARY;
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        // Beyond that, textures are refused in time. Some drivers would lose the device.
        memory_budget_thresholds: wgpu::MemoryBudgetThresholds {
            for_resource_creation: Some(MOST_MEMORY_PERCENT),
            for_device_loss: None,
        },
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    };
    let mut adapters = pollster::block_on(instance.enumerate_adapters(backends));
    let first = adapters.first().map(|a| a.get_info().name);
    adapters.retain(|a| wgpu::Limits::default().check_limits(&a.limits()));
    adapters.sort_by_key(rank);
    if adapters.is_empty() {
        let too_small = first.map(|name| format!("'{name}' lacks what the kernels need"));
        return Err(GpuError::NoAdapter(too_small.unwrap_or_else(|| "no driver offers a device".into())));
    }
    Ok(adapters)
}

/// Most of a device's memory that may be in use, by everybody.
const MOST_MEMORY_PERCENT: u8 = 90;

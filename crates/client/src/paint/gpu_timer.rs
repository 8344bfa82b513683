//! Measures how long the GPU works on a novel view, by timestamps inside egui's render pass or around a pass of its
//! own.
//!
//! A measurement takes three refreshes. The pass writes two timestamps, the next refresh copies them out, and the one
//! after requests their mapping. A later refresh finds that done, and only then a new measurement starts. So nothing
//! ever waits for the GPU.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::time::Duration;

/// Two timestamps around a draw.
pub(crate) struct GpuTimer {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readback: wgpu::Buffer,
    nanos_per_tick: f32,
    stage: Arc<AtomicU8>,
    result: Arc<GpuTime>,
}

/// The newest measurement, shared with the overlay.
#[derive(Debug, Default)]
pub(crate) struct GpuTime(AtomicU64);

impl GpuTime {
    pub(crate) fn get(&self) -> Option<Duration> {
        let nanos = self.0.load(Ordering::Relaxed);
        (nanos > 0).then(|| Duration::from_nanos(nanos))
    }
}

/// The features that timing inside a pass needs; none if the adapter lacks one. A software adapter draws after the
/// pass has ended, so its timestamps would be too short.
pub(crate) fn timer_features(adapter: &wgpu::Adapter) -> wgpu::Features {
    let wanted = wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES;
    let is_software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
    if adapter.features().contains(wanted) && !is_software { wanted } else { wgpu::Features::empty() }
}

impl GpuTimer {
    /// A timer that reports to `result`; none if the device lacks the features.
    pub(crate) fn new(device: &wgpu::Device, queue: &wgpu::Queue, result: Arc<GpuTime>) -> Option<Self> {
        if !device.features().contains(wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES) {
            return None;
        }
        let buffer = |label, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: QUERY_BYTES,
                usage: usage | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        Some(Self {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("novel view timestamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2,
            }),
            resolved: buffer(
                "resolved timestamps",
                wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            ),
            readback: buffer("timestamps on the CPU", wgpu::BufferUsages::MAP_READ),
            nanos_per_tick: queue.get_timestamp_period(),
            stage: Arc::new(AtomicU8::new(IDLE)),
            result,
        })
    }

    /// Advances a measurement, before the pass.
    pub(crate) fn step(&self, device: &wgpu::Device, encoder: &mut wgpu::CommandEncoder) {
        match self.stage.load(Ordering::Acquire) {
            WRITTEN => {
                encoder.resolve_query_set(&self.queries, 0..2, &self.resolved, 0);
                encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readback, 0, QUERY_BYTES);
                self.stage.store(COPIED, Ordering::Release);
            }
            COPIED => {
                self.stage.store(MAPPING, Ordering::Release);
                let (stage, result, nanos) = (self.stage.clone(), self.result.clone(), self.nanos_per_tick);
                let buffer = self.readback.clone();
                self.readback.map_async(wgpu::MapMode::Read, .., move |mapped| {
                    if mapped.is_ok() {
                        if let Ok(view) = buffer.get_mapped_range(..) {
                            let tick =
                                |i: usize| u64::from_le_bytes(std::array::from_fn(|j| view[8 * i + j]));
                            let ticks = tick(1).saturating_sub(tick(0));
                            result.0.store((ticks as f64 * f64::from(nanos)) as u64, Ordering::Relaxed);
                        }
                        buffer.unmap();
                    }
                    stage.store(IDLE, Ordering::Release);
                });
            }
            MAPPING => {
                // Runs the callback if the mapping is done. A lost device closes the window elsewhere.
                let _ = isinglass_gpu::poll(device, wgpu::PollType::Poll);
            }
            _ => {}
        }
    }

    /// The timestamps of a pass of its own, if no measurement is in progress.
    pub(crate) fn of_pass(&self) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        (self.stage.load(Ordering::Acquire) == IDLE).then(|| {
            self.stage.store(WRITTEN, Ordering::Release);
            wgpu::RenderPassTimestampWrites {
                query_set: &self.queries,
                beginning_of_pass_write_index: Some(0),
                end_of_pass_write_index: Some(1),
            }
        })
    }

    /// Puts `draw` between two timestamps inside the pass, if no measurement is in progress.
    pub(crate) fn around(
        &self,
        pass: &mut wgpu::RenderPass<'static>,
        draw: impl FnOnce(&mut wgpu::RenderPass<'static>),
    ) {
        let measures = self.stage.load(Ordering::Acquire) == IDLE;
        if measures {
            pass.write_timestamp(&self.queries, 0);
        }
        draw(pass);
        if measures {
            pass.write_timestamp(&self.queries, 1);
            self.stage.store(WRITTEN, Ordering::Release);
        }
    }
}

const QUERY_BYTES: u64 = 16;
const IDLE: u8 = 0;
const WRITTEN: u8 = 1;
const COPIED: u8 = 2;
const MAPPING: u8 = 3;

//! Measures compute passes by the device's own clock: a timestamp before and after each pass.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use crate::device::Gpu;
use crate::error::GpuError;
use crate::readback::Readback;

/// Timestamps of the passes in one piece of work.
pub(crate) struct PassClock {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    nanos_per_tick: f32,
    /// The next free query, or [`IDLE`] if nothing is timed.
    next: AtomicU32,
}

impl PassClock {
    /// The device features for a clock, as far as the adapter has them.
    pub(crate) fn features(adapter: &wgpu::Adapter) -> wgpu::Features {
        adapter.features() & wgpu::Features::TIMESTAMP_QUERY
    }

    /// `None` if the device has no timestamps.
    pub(crate) fn new(device: &wgpu::Device, queue: &wgpu::Queue) -> Option<Self> {
        device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Self {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("timestamps of passes"),
                ty: wgpu::QueryType::Timestamp,
                count: MAX_QUERIES,
            }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("resolved timestamps of passes"),
                size: u64::from(MAX_QUERIES) * size_of::<u64>() as u64,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            nanos_per_tick: queue.get_timestamp_period(),
            next: AtomicU32::new(IDLE),
        })
    }

    /// The two timestamps of the next pass, if passes are timed.
    fn next_pass(&self) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let take = |n| (n != IDLE).then(|| n + 2);
        let first = self.next.try_update(Ordering::Relaxed, Ordering::Relaxed, take).ok()?;
        (first + 2 <= MAX_QUERIES).then_some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        })
    }

    /// The summed time of the first `num` timestamps, two per pass.
    fn read(&self, gpu: &Gpu, num: u32) -> Result<Duration, GpuError> {
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.resolve_query_set(&self.queries, 0..num, &self.resolved, 0);
        let mut ticks: Vec<u64> = Vec::new();
        Readback::default().read(gpu, encoder, [(&self.resolved, num as usize)], [&mut ticks])?;
        let sum: u64 = ticks.chunks_exact(2).map(|t| t[1].saturating_sub(t[0])).sum();
        Ok(Duration::from_nanos((sum as f64 * f64::from(self.nanos_per_tick)) as u64))
    }
}

impl Gpu {
    /// The descriptor of a compute pass: with timestamps while [`Gpu::timed`] runs.
    pub(crate) fn pass(&self) -> wgpu::ComputePassDescriptor<'_> {
        let timestamp_writes = self.pass_clock().and_then(PassClock::next_pass);
        wgpu::ComputePassDescriptor { label: None, timestamp_writes }
    }

    /// Runs `body` and measures its submitted passes on the device, without readback. There is no time without
    /// passes, with more than a thousand, without timestamps, or on a software adapter, whose timestamps mean little.
    /// Passes of other threads count too.
    ///
    /// # Errors
    /// Those of `body`, and if timestamps cannot be read.
    pub fn timed<T, E: From<GpuError>>(
        &self,
        body: impl FnOnce() -> Result<T, E>,
    ) -> Result<(T, Option<Duration>), E> {
        match self.pass_clock().filter(|_| !self.info().is_software) {
            Some(clock) => self.timed_by(clock, body),
            None => Ok((body()?, None)),
        }
    }

    fn timed_by<T, E: From<GpuError>>(
        &self,
        clock: &PassClock,
        body: impl FnOnce() -> Result<T, E>,
    ) -> Result<(T, Option<Duration>), E> {
        clock.next.store(0, Ordering::Relaxed);
        let result = body();
        let num = clock.next.swap(IDLE, Ordering::Relaxed);
        let result = result?;
        let time = if (1..=MAX_QUERIES).contains(&num) {
            Some(self.attempt("reading timestamps", || clock.read(self, num))?)
        } else {
            None
        };
        Ok((result, time))
    }
}

/// A thousand passes: a frame at 1920×1080 has a few tens.
const MAX_QUERIES: u32 = 2048;
const IDLE: u32 = u32::MAX;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::kernels::march::{MarchSettings, Scene};
    use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use isinglass_core::volume::procedural::Builtin;

    use super::*;
    use crate::march::GpuRenderer;

    /// On a software device too, where the plumbing is the same.
    #[test]
    fn only_passes_of_the_body_are_timed() {
        let Ok(gpu) = Gpu::open() else {
            assert!(std::env::var_os("ISINGLASS_STRICT").is_none(), "no GPU adapter");
            return;
        };
        let Some(clock) = gpu.pass_clock() else { return };
        let point = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
        let transfer = TransferFunction {
            name: "test".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: vec![point(0.0, 0.0), point(1.0, 0.1)],
        };
        let scene = Scene::new(Arc::new(Builtin::Cloud.volume(32)), &transfer, MarchSettings::default());
        let bounds = scene.volume.bounds();
        let intrinsics = Intrinsics::perspective(64, 64, 0.6);
        let pose = Pose::orbit(bounds.center(), 0.3, 0.2, bounds.radius() * intrinsics.fit_distance());
        let camera = Camera::new(pose, intrinsics, &bounds);
        let mut renderer = GpuRenderer::new(&gpu, scene).unwrap();
        let (plain, time) = gpu.timed_by::<_, GpuError>(clock, || renderer.render(&camera)).unwrap();
        assert!(time.is_some_and(|time| time > Duration::ZERO), "{time:?}");
        // Neither work without a pass nor an error leaves the clock running.
        assert_eq!(gpu.timed_by::<_, GpuError>(clock, || Ok(1)).unwrap(), (1, None));
        assert!(gpu.timed_by::<(), _>(clock, || Err(GpuError::Camera)).is_err());
        assert!(gpu.pass().timestamp_writes.is_none());
        assert_eq!(renderer.render(&camera).unwrap().pixels, plain.pixels);
        let (_, time) = gpu.timed::<_, GpuError>(|| renderer.render(&camera)).unwrap();
        assert_eq!(time.is_some(), !gpu.info().is_software);
    }
}

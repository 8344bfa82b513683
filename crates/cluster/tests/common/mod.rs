//! Threads that hold the parts of a volume.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use glam::Vec3;
use isinglass_cluster::{Cluster, Exchange, ExchangeError, InProcess, OrderQueue, Orders, in_whole, orders};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{GHOSTS, Lighting, Split, Volume};

pub(crate) fn look(opacity: f32, lighting: Lighting) -> Look {
    let point = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "step".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(0.1),
        points: vec![
            point(0.0, [0.2, 0.4, 1.0], 0.0),
            point(0.3, [1.0, 0.8, 0.3], 0.0),
            point(1.0, [1.0; 3], opacity),
        ],
    };
    Look { lighting, ..Look::new(transfer) }
}

pub(crate) fn lit() -> Lighting {
    Lighting { ambient_occlusion: 0.9, shadows: 0.8, ..Lighting::default() }
}

pub(crate) fn camera(volume: &Volume, degrees: f32) -> Camera {
    let bounds = volume.bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.35, 2.6 * bounds.radius());
    Camera::new(pose, Intrinsics::perspective(96, 80, 0.8), &bounds)
}

/// Counts the bytes that come to process 0 from others.
struct Counted {
    inner: InProcess,
    come: Arc<AtomicU64>,
}

impl Exchange for Counted {
    fn rank(&self) -> usize {
        self.inner.rank()
    }

    fn size(&self) -> usize {
        self.inner.size()
    }

    fn all_to_all(&self, words: Vec<Vec<u32>>) -> Result<Vec<Vec<u32>>, ExchangeError> {
        let found = self.inner.all_to_all(words)?;
        if self.rank() == 0 {
            let bytes = found[1..].iter().map(|words| words.len() as u64 * 4).sum();
            self.come.fetch_add(bytes, Ordering::Relaxed);
        }
        Ok(found)
    }

    fn abort(&self) -> ! {
        self.inner.abort()
    }
}

/// Process 0 works on the orders that `serve` gives with the scene of its part. It also gets the number of bytes that have
/// come to process 0 from others. Each process has a thread.
pub(crate) fn served<R: Send>(
    volume: &Volume,
    split: &Split,
    look: &Look,
    serve: impl FnOnce(Orders, &Scene, &AtomicU64) -> R + Send,
) -> R {
    let part = |exchange: &Counted| {
        let rank = exchange.rank();
        let (own, held) = (split.boxes()[rank], split.held(rank, GHOSTS));
        let part = volume.part(&held).unwrap();
        let part = in_whole(exchange, part, &own, &held, volume.dims(), None).unwrap();
        Scene::of_look(Arc::new(part), look)
    };
    let come = Arc::new(AtomicU64::new(0));
    let counted = |inner| Counted { inner, come: come.clone() };
    let mut all = InProcess::all(split.boxes().len()).into_iter().map(counted);
    let first = all.next().unwrap();
    let (orders, queue): (Orders, OrderQueue) = orders();
    std::thread::scope(|scope| {
        for exchange in all {
            let part = &part;
            scope.spawn(move || {
                let base = part(&exchange);
                Cluster::new(&exchange, split.clone()).help(&base).unwrap();
            });
        }
        let base = part(&first);
        let (own, volume) = (base.clone(), base.whole().clone());
        let count = come.clone();
        let serving = scope.spawn(move || serve(orders, &own, &count));
        Cluster::new(&first, split.clone()).work_on(queue, &volume).unwrap();
        serving.join().unwrap()
    })
}

//! What several tests of frames look at.

use std::sync::Arc;

use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;

/// A built-in volume of 40³ voxels that rays go far into.
pub(crate) fn scene(builtin: Builtin) -> Scene {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(0.02),
        points: vec![
            p(0.0, [0.1, 0.2, 0.9], 0.0),
            p(0.2, [0.2, 0.8, 0.5], 0.05),
            p(0.8, [0.9, 0.6, 0.2], 0.5),
            p(1.0, [1.0, 1.0, 0.9], 0.9),
        ],
    };
    Scene::new(Arc::new(builtin.volume(40)), &transfer, MarchSettings::default())
}

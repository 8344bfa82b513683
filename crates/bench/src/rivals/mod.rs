//! The ways of making a picture from a layered frame, side by side: ours and those of the papers.
//!
//! The rivals run on the CPU, from *any* layered frame, so that every method can be asked what it makes of the same
//! data: [`PointWarp`] flattens the lists to one colour and one depth a pixel, [`Slabs`] cuts them at planes. On a
//! frame of its own rule (`single-depth`, `slabs`) that derivation changes nothing.

mod point_warp;
mod slab_mesh;
mod slabs;
mod warp;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use isinglass_core::camera::Camera;
use isinglass_core::kernels::layering::Layering;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_gpu::{Backend, Reprojector};

use crate::error::BenchError;

pub use point_warp::PointWarp;
pub use slab_mesh::SlabMesh;
pub use slabs::Slabs;

/// The methods by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// The layered frame is ray-cast (ours; Gupta 2022, Lochmann 2016).
    #[default]
    Layers,
    /// Every pixel is a point at one depth (Zellmann 2012).
    PointWarp,
    /// Slabs of the volume, each an image on its middle plane (Mueller 1999).
    SlabsPlanar,
    /// The same images on meshes of 16×16-pixel quads at the depth of their content (Mueller 1999).
    SlabsMesh,
    /// The picture of the frame's own camera, unchanged: what a viewer of pictures shows.
    LastImage,
}

impl Method {
    /// Every method.
    pub const ALL: [Self; 5] =
        [Self::Layers, Self::PointWarp, Self::SlabsPlanar, Self::SlabsMesh, Self::LastImage];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Layers => "layers",
            Self::PointWarp => "point-warp",
            Self::SlabsPlanar => "slabs-planar",
            Self::SlabsMesh => "slabs-mesh",
            Self::LastImage => "last-image",
        }
    }

    /// The name in tables: what is ray-cast is called by the rule of the frame, `layering`.
    pub fn name_with(self, layering: Layering) -> &'static str {
        if self == Self::Layers { layering.name() } else { self.name() }
    }

    /// Makes a frame ready for any number of views. `bounds` is the box of the volume. Only [`Method::Layers`] runs on
    /// `backend`.
    pub fn prepare(
        self,
        backend: &Backend,
        frame: Arc<LayeredFrame>,
        bounds: &Aabb,
    ) -> Result<Views, BenchError> {
        Ok(match self {
            Self::Layers => Views::Layers(backend.reprojector(frame, bounds)?),
            Self::PointWarp => Views::PointWarp(PointWarp::new(&frame)),
            Self::SlabsPlanar => Views::SlabsPlanar(Slabs::new(&frame)),
            Self::SlabsMesh => Views::SlabsMesh(SlabMesh::new(Slabs::new(&frame))),
            Self::LastImage => Views::LastImage(frame.flatten()),
        })
    }
}

impl std::fmt::Display for Method {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Method {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|m| m.name() == s).ok_or_else(|| {
            format!("unknown method '{s}', expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

/// One layered frame, kept by a method for any number of views.
pub enum Views {
    /// See [`Method::Layers`].
    Layers(Reprojector),
    /// See [`Method::PointWarp`].
    PointWarp(PointWarp),
    /// See [`Method::SlabsPlanar`].
    SlabsPlanar(Slabs),
    /// See [`Method::SlabsMesh`].
    SlabsMesh(SlabMesh),
    /// See [`Method::LastImage`].
    LastImage(Picture),
}

impl Views {
    /// The picture from a camera. Premultiplied linear.
    pub fn view(&mut self, camera: &Camera) -> Result<Picture, BenchError> {
        if !camera.is_valid() {
            return Err(BenchError::Gpu(isinglass_gpu::GpuError::Camera));
        }
        Ok(match self {
            Self::Layers(reprojector) => reprojector.raycast(camera)?,
            Self::PointWarp(points) => points.view(camera),
            Self::SlabsPlanar(slabs) => slabs.view(camera),
            Self::SlabsMesh(mesh) => mesh.view(camera),
            Self::LastImage(picture) => stretch(picture, camera),
        })
    }
}

/// The picture at the camera's size; where sizes agree, unchanged.
fn stretch(picture: &Picture, camera: &Camera) -> Picture {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if (picture.width, picture.height) == (width, height) {
        return picture.clone();
    }
    let mut out = Picture::new(width, height);
    let scale = [picture.width as f32 / width as f32, picture.height as f32 / height as f32];
    for (i, pixel) in out.pixels.iter_mut().enumerate() {
        let (x, y) = (i as u32 % width, i as u32 / width);
        let at = [(x as f32 + 0.5) * scale[0], (y as f32 + 0.5) * scale[1]];
        let texel = |x: usize, y: usize| picture.pixels[y * picture.width as usize + x];
        *pixel = warp::bilinear([picture.width as usize, picture.height as usize], at, texel);
    }
    out
}

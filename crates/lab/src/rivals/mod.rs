//! Methods that make a picture of a layered frame: ours and those of the papers.
//!
//! The rivals run on the CPU, from *any* layered frame, so that all methods get the same data: [`PointWarp`] flattens
//! the lists to one colour and one depth per pixel, [`Slabs`] cuts them at planes. On a frame of its own rule
//! (`single-depth`, `slabs`) that derivation changes nothing.

mod point_warp;
mod slab_mesh;
mod slabs;
mod warp;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use crate::rules::Rule;
use isinglass_client::NovelView;
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_net::ReceivedFrame;
use isinglass_render::{Backend, Reprojector};

use crate::error::LabError;

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

    /// The name in tables: that of the frame's rule for the ray cast.
    pub fn name_on(self, rule: Rule) -> &'static str {
        if self == Self::Layers { rule.name() } else { self.name() }
    }

    /// Whether it makes pictures of frames of this mode: all but the ray cast composite with over.
    ///
    /// # Errors
    /// If not.
    pub fn check_mode(self, mode: Mode) -> Result<(), LabError> {
        match self == Self::Layers || !mode.is_projection() {
            true => Ok(()),
            false => Err(LabError::Mode { method: self, mode }),
        }
    }

    /// Where its pictures are made: rivals run on the CPU.
    pub fn backend(self, backend: &Backend) -> &Backend {
        if self == Self::Layers { backend } else { &Backend::Cpu }
    }

    /// Prepares a frame for any number of views. `bounds` is the box of the volume. Only [`Method::Layers`] runs on
    /// `backend`.
    pub fn prepare(
        self,
        backend: &Backend,
        frame: Arc<LayeredFrame>,
        bounds: &Aabb,
    ) -> Result<Views, LabError> {
        match self.prepare_rival(&frame, bounds) {
            Some(views) => Ok(views),
            None => Ok(Views::Layers(backend.reprojector(frame, bounds)?)),
        }
    }

    /// One picture of a frame. For several views use [`Method::prepare`].
    pub fn draw(
        self,
        backend: &Backend,
        frame: &LayeredFrame,
        bounds: &Aabb,
        camera: &Camera,
    ) -> Result<Picture, LabError> {
        match self.prepare_rival(frame, bounds) {
            Some(mut views) => views.view(camera),
            None => Ok(backend.raycast(frame, bounds, camera)?),
        }
    }

    /// `None` for the ray cast.
    pub(crate) fn prepare_rival(self, frame: &LayeredFrame, bounds: &Aabb) -> Option<Views> {
        Some(match self {
            Self::Layers => return None,
            Self::PointWarp => Views::PointWarp(PointWarp::new(frame)),
            Self::SlabsPlanar => Views::SlabsPlanar(Slabs::new(frame, bounds)),
            Self::SlabsMesh => Views::SlabsMesh(SlabMesh::new(Slabs::new(frame, bounds))),
            Self::LastImage => Views::LastImage(frame.flatten(), frame.header.camera.intrinsics),
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
    LastImage(Picture, Intrinsics),
}

impl Views {
    /// The picture from a camera, premultiplied linear.
    pub fn view(&mut self, camera: &Camera) -> Result<Picture, LabError> {
        self.view_with(camera, &CastOptions::default())
    }

    /// The same, with `options` for the ray cast.
    pub fn view_with(&mut self, camera: &Camera, options: &CastOptions) -> Result<Picture, LabError> {
        if !camera.is_valid() {
            return Err(isinglass_gpu::GpuError::Camera.into());
        }
        Ok(match self {
            Self::Layers(reprojector) => reprojector.raycast_with(camera, options)?,
            Self::PointWarp(points) => points.view(camera),
            Self::SlabsPlanar(slabs) => slabs.view(camera),
            Self::SlabsMesh(mesh) => mesh.view(camera),
            Self::LastImage(picture, of) => stretch(picture, of, camera),
        })
    }
}

impl Method {
    /// The method for the viewer; `None` for the ray cast, which the viewer has itself.
    pub fn for_viewer(self) -> Option<Box<dyn NovelView>> {
        (self != Self::Layers).then(|| Box::new(ShownRival { method: self, kept: None }) as _)
    }
}

/// A method in the viewer, with the newest frame.
struct ShownRival {
    method: Method,
    kept: Option<(Arc<ReceivedFrame>, Views)>,
}

impl NovelView for ShownRival {
    fn name(&self) -> &'static str {
        self.method.name()
    }

    fn draw(
        &mut self,
        frame: &Arc<ReceivedFrame>,
        bounds: &Aabb,
        camera: &Camera,
    ) -> Result<Picture, String> {
        if self.kept.as_ref().is_none_or(|(kept, _)| !Arc::ptr_eq(kept, frame)) {
            self.kept = self.method.prepare_rival(&frame.frame, bounds).map(|views| (frame.clone(), views));
        }
        let (_, views) = self.kept.as_mut().ok_or("the viewer casts layers itself")?;
        views.view(camera).map_err(|e| e.to_string())
    }
}

/// The part of a picture, made with `of`, that the camera's field of view takes up, at the camera's size, as if both
/// cameras looked the same way; where they agree, unchanged. Transparent beyond the picture.
pub(crate) fn stretch(picture: &Picture, of: &Intrinsics, camera: &Camera) -> Picture {
    let shown = camera.intrinsics;
    if shown == *of {
        return picture.clone();
    }
    let mut out = Picture::new(shown.width, shown.height);
    let size = [of.width as usize, of.height as usize];
    let ((of_x, of_y), (shown_x, shown_y)) = (of.half_size_at(1.0), shown.half_size_at(1.0));
    // From the middle of one to the middle of the other, by the tangents that a pixel spans.
    let map = |p: u32, n: u32, tan: f32, n_of: u32, tan_of: f32| {
        let from_middle = (p as f32 + 0.5) / n as f32 - 0.5;
        (from_middle * (tan / tan_of) + 0.5) * n_of as f32
    };
    for (i, pixel) in out.pixels.iter_mut().enumerate() {
        let (x, y) = (i as u32 % shown.width, i as u32 / shown.width);
        let at =
            [map(x, shown.width, shown_x, of.width, of_x), map(y, shown.height, shown_y, of.height, of_y)];
        if (0.0..=size[0] as f32).contains(&at[0]) && (0.0..=size[1] as f32).contains(&at[1]) {
            *pixel = warp::bilinear(size, at, |x, y| picture.pixels[y * size[0] + x]);
        }
    }
    out
}

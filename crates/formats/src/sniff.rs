//! Tells formats apart by their first bytes, and by the end of the name where they have no mark of their own.

use std::path::Path;

use crate::{dicom, metaimage, mrc, nifti, npy};

/// A format, as far as the first bytes tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Nrrd,
    Nifti,
    /// A NIfTI file, or anything else, in gzip.
    Gzip,
    MetaImage,
    Npy,
    Zip,
    Mrc,
    Tiff,
    Dicom,
    Vti,
    /// None that is read here; what it looks like.
    Other(&'static str),
}

impl Kind {
    /// Whether one such file is a volume by itself, as far as this tells.
    pub(crate) fn is_whole_volume(self) -> bool {
        matches!(self, Self::Nrrd | Self::Nifti | Self::MetaImage | Self::Npy | Self::Mrc | Self::Vti)
    }

    /// What a file of this kind is called in a message.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Nrrd => "an NRRD file",
            Self::Nifti => "a NIfTI file",
            Self::Gzip => "gzip data",
            Self::MetaImage => "a MetaImage file",
            Self::Npy => "a NumPy array",
            Self::Zip => "a ZIP archive",
            Self::Mrc => "an MRC file",
            Self::Tiff => "a TIFF file",
            Self::Dicom => "a DICOM file",
            Self::Vti => "a VTK file",
            Self::Other(name) => name,
        }
    }
}

/// The kind of the file at `path` that begins with `start`.
pub(crate) fn kind_of(start: &[u8], path: &Path) -> Kind {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    match () {
        () if start.is_empty() => Kind::Other("an empty file"),
        () if is_at(0, b"NRRD") => Kind::Nrrd,
        () if is_at(0, &[0x1f, 0x8b]) => Kind::Gzip,
        () if [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| is_at(0, *magic)) => Kind::Tiff,
        () if is_at(0, b"<VTKFile") || (is_at(0, b"<?xml") && contains(start, b"<VTKFile")) => Kind::Vti,
        () if nifti::is_header(start) => Kind::Nifti,
        () if metaimage::is_header(start) => Kind::MetaImage,
        () if is_at(0, npy::MAGIC) => Kind::Npy,
        () if is_at(0, b"PK\x03\x04") || is_at(0, b"PK\x05\x06") => Kind::Zip,
        () if mrc::is_header(start, path) => Kind::Mrc,
        () if dicom::is_header(start) => Kind::Dicom,
        () => Kind::Other(named(start, path).unwrap_or_else(|| other_name(start))),
    }
}

/// What a file is that only its name tells, or its name and a few bytes.
fn named(start: &[u8], path: &Path) -> Option<&'static str> {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_ascii_lowercase();
    match () {
        // The version of all MGH files, the highest byte first.
        () if name.ends_with(".mgh") && start.starts_with(&[0, 0, 0, 1]) => Some(MGH),
        () if name.ends_with(".img") && path.with_extension("hdr").is_file() => {
            Some("voxels of a pair of files")
        }
        () if name.ends_with(".img") => Some("voxels without their .hdr file"),
        () => None,
    }
}

/// What gzip data at `path` is that is no NIfTI file.
pub(crate) fn gzip_name(path: &Path) -> &'static str {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_ascii_lowercase();
    match () {
        () if name.ends_with(".mgz") || name.ends_with(".mgh.gz") => MGH,
        () if name.ends_with(".tar.gz") || name.ends_with(".tgz") => "a packed folder (tar)",
        () => "gzip data that is no NIfTI file",
    }
}

/// What could be read in place of a file that was found to be `found`: the way to it, where there is one.
pub(crate) fn expected_for(found: &str) -> &'static str {
    WAYS.iter().find(|(name, _)| *name == found).map_or(EXPECTED, |(_, way)| way)
}

/// What a file that is not read here looks like, so that the message helps.
fn other_name(start: &[u8]) -> &'static str {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    match () {
        () if is_at(0, b"# vtk") => "a legacy VTK file",
        () if (is_at(0, b"<?xml") || is_at(0, b"<OME")) && contains(start, b"<OME") => {
            "the description of an OME-TIFF"
        }
        () if is_at(0, b"<?xml") => "an XML document of another kind",
        () if is_at(0, b"IGLF") => "a stored layered frame",
        () if is_at(0, b"\x89HDF") => "an HDF5 file",
        () if is_at(0, b"\x89PNG") => "a PNG picture",
        () if is_at(0, &[0xff, 0xd8, 0xff]) => "a JPEG picture",
        () if is_at(0, b"CDF") => "a netCDF file",
        () if is_at(0, b"BZh") || is_at(0, b"\xfd7zXZ") || is_at(0, b"\x28\xb5\x2f\xfd") => "compressed data",
        () if is_at(0, &[0x5c, 1, 0, 0]) || is_at(0, &[0, 0, 1, 0x5c]) => "an Analyze header",
        () if is_at(0, b"ZISRAWFILE") => "a Zeiss CZI file",
        // Leica's blocks: 0x70, their length, 0x2a.
        () if is_at(0, &[0x70, 0, 0, 0]) && is_at(8, &[0x2a]) => "a Leica LIF file",
        () if is_at(0, &[0xda, 0xce, 0xbe, 0x0a]) => "a Nikon ND2 file",
        () if is_at(0, b"\0\0\0\x0cjP  ") => "a JPEG 2000 picture or an old Nikon ND2 file",
        () if is_at(0, &[0xd0, 0xcf, 0x11, 0xe0]) => "a compound document (Olympus OIB, Zeiss ZVI)",
        () => "no header that is known",
    }
}

fn contains(bytes: &[u8], word: &[u8]) -> bool {
    bytes.windows(word.len()).any(|w| w == word)
}

const MGH: &str = "a FreeSurfer MGH volume";

/// How a volume comes out of files that are not read here.
const WAYS: [(&str, &str); 10] = [
    (MGH, "NIfTI, which `mri_convert FILE FILE.nii.gz` makes of it"),
    ("an Analyze header", "NIfTI, which `nib-convert FILE.hdr FILE.nii` (nibabel) makes of it"),
    ("voxels of a pair of files", "the .hdr file beside it"),
    ("voxels without their .hdr file", "the .hdr file, with the .img beside it"),
    ("a Zeiss CZI file", BIO_FORMATS),
    ("a Leica LIF file", BIO_FORMATS),
    ("a Nikon ND2 file", BIO_FORMATS),
    ("a JPEG 2000 picture or an old Nikon ND2 file", BIO_FORMATS),
    ("a compound document (Olympus OIB, Zeiss ZVI)", BIO_FORMATS),
    ("the description of an OME-TIFF", "one of the TIFF files beside it"),
];

const BIO_FORMATS: &str = "OME-TIFF, which `bfconvert FILE FILE.ome.tif` (Bio-Formats) makes of it";

/// What could be read.
pub(crate) const EXPECTED: &str = "an NRRD file, NIfTI, MetaImage, TIFF, DICOM, VTI, MRC, NumPy or OME-Zarr, or raw voxels with their dimensions and type given";

/// Enough for the marks of the formats that are told apart.
pub(crate) const SNIFFED_BYTES: u64 = 1024;

//! Recognises formats by their first bytes. Formats without a mark need a known suffix.

use std::path::Path;

use crate::{dicom, hdf5, metaimage, mgh, mrc, netcdf, nifti, npy, vtk};

/// The format of a file, judged by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FileKind {
    Nrrd,
    Nifti,
    /// Gzip data of any format.
    Gzip,
    MetaImage,
    Npy,
    Zip,
    Mrc,
    Tiff,
    Dicom,
    Vti,
    Vtk,
    Mgh,
    Png,
    Hdf5,
    /// The description of an HDF5 file of BigDataViewer.
    BigDataViewer,
    /// A classic file; newer ones are HDF5.
    Netcdf,
    /// An unsupported format, with a description.
    Other(&'static str),
}

impl FileKind {
    /// Whether a single file of this format is a volume.
    pub(crate) fn is_whole_volume(self) -> bool {
        matches!(
            self,
            Self::Nrrd
                | Self::Nifti
                | Self::MetaImage
                | Self::Npy
                | Self::Mrc
                | Self::Vti
                | Self::Vtk
                | Self::Mgh
                | Self::Hdf5
                | Self::BigDataViewer
                | Self::Netcdf
        )
    }

    /// The name of such a file in a message.
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
            Self::Vti | Self::Vtk => "a VTK file",
            Self::Mgh => "a FreeSurfer MGH volume",
            Self::Png => "a PNG picture",
            Self::Hdf5 => "an HDF5 file",
            Self::BigDataViewer => "a description of BigDataViewer",
            Self::Netcdf => "a netCDF file",
            Self::Other(name) => name,
        }
    }
}

/// The format of the file at `path`, which begins with `start`.
pub(crate) fn kind_of(start: &[u8], path: &Path) -> FileKind {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    match () {
        () if start.is_empty() => FileKind::Other("an empty file"),
        // Before the mark is a preamble, which may look like a file of another kind.
        () if is_at(128, b"DICM") => FileKind::Dicom,
        () if is_at(0, b"NRRD") => FileKind::Nrrd,
        () if is_at(0, &[0x1f, 0x8b]) => FileKind::Gzip,
        () if [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| is_at(0, *magic)) => FileKind::Tiff,
        () if is_at(0, b"<VTKFile") || (is_at(0, b"<?xml") && contains(start, b"<VTKFile")) => FileKind::Vti,
        () if nifti::is_header(start) => FileKind::Nifti,
        () if metaimage::is_header(start) => FileKind::MetaImage,
        () if is_at(0, npy::MAGIC) => FileKind::Npy,
        () if is_at(0, b"PK\x03\x04") || is_at(0, b"PK\x05\x06") => FileKind::Zip,
        () if is_at(0, vtk::MAGIC) => FileKind::Vtk,
        () if is_at(0, b"\x89PNG") => FileKind::Png,
        () if hdf5::is_header(start) => FileKind::Hdf5,
        () if hdf5::is_description(start) => FileKind::BigDataViewer,
        () if netcdf::is_header(start) => FileKind::Netcdf,
        () if mgh::is_header(start, path) => FileKind::Mgh,
        () if mrc::is_header(start, path) => FileKind::Mrc,
        () if dicom::is_header(start) => FileKind::Dicom,
        () if hdf5::is_after_user_block(path) => FileKind::Hdf5,
        () => FileKind::Other(named(start, path).unwrap_or_else(|| other_name(start))),
    }
}

/// Unsupported formats that are recognised by the name of the file.
fn named(start: &[u8], path: &Path) -> Option<&'static str> {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_ascii_lowercase();
    match () {
        () if name.ends_with(".img") && path.with_extension("hdr").is_file() => Some(PAIR),
        () if name.ends_with(".img") && !is_lfs_pointer(start) => Some("voxels without their .hdr file"),
        () => None,
    }
}

/// Whether a file is a pointer to one that Git keeps elsewhere.
pub(crate) fn is_lfs_pointer(start: &[u8]) -> bool {
    start.starts_with(LFS)
}

/// A description of gzip data at `path` of an unknown format.
pub(crate) fn gzip_name(path: &Path) -> &'static str {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_ascii_lowercase();
    match () {
        () if name.ends_with(".tar.gz") || name.ends_with(".tgz") => "a packed folder (tar)",
        () => "gzip data of an unknown format",
    }
}

/// What the user can open instead of a file that is `found`.
pub(crate) fn expected_for(found: &str) -> &'static str {
    WAYS.iter().find(|(name, _)| *name == found).map_or(EXPECTED, |(_, way)| way)
}

/// A description of an unsupported file.
fn other_name(start: &[u8]) -> &'static str {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    match () {
        () if is_lfs_pointer(start) => LFS_NAME,
        () if (is_at(0, b"<?xml") || is_at(0, b"<OME")) && contains(start, b"<OME") => {
            "the description of an OME-TIFF"
        }
        () if is_at(0, b"<?xml") => "an XML document of another kind",
        () if is_at(0, b"IGLF") => "a stored layered frame",
        () if is_at(0, &[0xff, 0xd8, 0xff]) => "a JPEG picture",
        () if is_at(0, &[0xcd, 0xf3, 0, 1]) || is_at(0, &[0xcd, 0xf2, 0x60, 2]) => "a file of NASA's CDF",
        () if is_at(0, b"GRIB") => "a GRIB file",
        () if is_at(0, b"\x0e\x03\x13\x01") => "an HDF4 file",
        () if is_at(0, b"{") && contains(start, b"\"refs\"") => REFERENCES,
        () if is_at(0, b"BZh") || is_at(0, b"\xfd7zXZ") || is_at(0, b"\x28\xb5\x2f\xfd") => "compressed data",
        () if is_at(0, &[0x5c, 1, 0, 0]) || is_at(0, &[0, 0, 1, 0x5c]) => "an Analyze header",
        () if is_at(0, b"ZISRAWFILE") => "a Zeiss CZI file",
        // Leica's blocks begin with 0x70, their length and 0x2a.
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

/// A document that says where in other files the chunks of arrays are.
pub(crate) const REFERENCES: &str = "a list of references to other files (kerchunk)";
/// Voxels beside their header, which is opened instead.
pub(crate) const PAIR: &str = "voxels of a pair of files";
/// The first bytes of a pointer.
const LFS: &[u8] = b"version https://git-lfs.github.com/spec/";
pub(crate) const LFS_NAME: &str = "a Git LFS pointer in place of the file";

/// How a user converts unsupported files.
const WAYS: [(&str, &str); 13] = [
    (LFS_NAME, "the file itself, which `git lfs pull` fetches"),
    ("an Analyze header", "NIfTI, which `nib-convert FILE.hdr FILE.nii` (nibabel) makes of it"),
    ("voxels without their .hdr file", "the .hdr file, with the .img beside it"),
    ("a file of NASA's CDF", "NetCDF, which `cdf-to-netCDF` of NASA makes of it"),
    (
        "a GRIB file",
        "NetCDF, which `cdo -f nc4 copy FILE OUT.nc` or `grib_to_netcdf -o OUT.nc FILE` makes of it",
    ),
    ("an HDF4 file", "HDF5, which `h4toh5 FILE OUT.h5` makes of it"),
    (
        REFERENCES,
        "one of the files that it lists, or a Zarr group with their numbers, which xarray's `to_zarr` writes",
    ),
    ("a Zeiss CZI file", BIO_FORMATS),
    ("a Leica LIF file", BIO_FORMATS),
    ("a Nikon ND2 file", BIO_FORMATS),
    ("a JPEG 2000 picture or an old Nikon ND2 file", BIO_FORMATS),
    ("a compound document (Olympus OIB, Zeiss ZVI)", BIO_FORMATS),
    ("the description of an OME-TIFF", "one of the TIFF files beside it"),
];

const BIO_FORMATS: &str = "OME-TIFF, which `bfconvert FILE FILE.ome.tif` (Bio-Formats) makes of it";

pub(crate) const EXPECTED: &str = "an NRRD file, NIfTI, MetaImage, TIFF, DICOM, VTK image, MRC, MGH, NumPy, HDF5, NetCDF, Imaris or OME-Zarr, slices in a folder, or raw voxels with their dimensions and type given";

/// Bytes that are enough to recognise all formats.
pub(crate) const SNIFFED_BYTES: u64 = 1024;

//! The CF conventions (cfconventions.org), which files of climate, weather and ocean models follow: what the axes of a
//! variable are, where they point, and how numbers become values. NetCDF, HDF5 and the Zarr groups of xarray share it.

mod candidate;
mod coordinates;
mod layout;
mod names;
mod values;
mod variables;

pub(crate) use self::candidate::{Standing, VolumeCandidate};
pub(crate) use self::coordinates::{Coordinates, Unit, unit_of};
pub(crate) use self::layout::{num_in_space, plan};
pub(crate) use self::names::kind_of_name;
pub(crate) use self::values::{NumberMeaning, signed_as_told};
pub(crate) use self::variables::{Variable, Variables};

/// The attributes of a variable or a group, by their names.
pub(crate) trait AttributeList {
    /// The numbers of an attribute; empty if there is none.
    fn numbers(&self, name: &str) -> Vec<f64>;

    /// The text of an attribute.
    fn text(&self, name: &str) -> Option<String>;

    /// Whether the numbers of an attribute are floats.
    fn has_floats(&self, name: &str) -> bool;
}

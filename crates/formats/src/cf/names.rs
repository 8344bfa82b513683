//! What names, units and other words of coordinates tell of an axis.

use super::AttributeList;
use crate::plan::AxisKind;

/// What the words of a coordinate tell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct AxisWords {
    pub(super) kind: Option<AxisKind>,
    /// Whether its numbers rise downwards; `None` if nothing tells.
    pub(super) is_down: Option<bool>,
    /// Whether it is certainly an axis of the earth.
    pub(super) is_of_earth: bool,
}

impl AxisWords {
    /// The words of the coordinate or dimension `name`. Attributes count before names, as in the CF conventions.
    pub(super) fn of(name: &str, attributes: Option<&dyn AttributeList>) -> Self {
        let text = |key: &str| attributes.and_then(|list| list.text(key)).unwrap_or_default();
        let (units, standard, long) = (text("units"), text("standard_name"), text("long_name"));
        let (units, standard) = (units.trim().to_owned(), standard.trim().to_lowercase());
        let positive = text("positive").trim().to_lowercase();
        let is_pressure = is_pressure_unit(&units);
        let degrees = kind_of_degrees(&units);
        let told = kind_of_letter(&text("axis"))
            .or_else(|| is_since(&units).then_some(AxisKind::Time))
            .or(degrees)
            .or_else(|| kind_of_standard_name(&standard))
            .or_else(|| (!positive.is_empty() || is_pressure).then_some(AxisKind::Space(2)))
            .or_else(|| kind_of_letter(&text("cartesian_axis")));
        let kind = told.or_else(|| kind_of_name(name)).or_else(|| kind_of_name(&long));
        if kind != Some(AxisKind::Space(2)) {
            let is_of_earth = degrees.is_some()
                || is_model_name(name)
                || (told.is_some() && !standard.is_empty() && kind != Some(AxisKind::Time));
            return Self { kind, is_down: None, is_of_earth };
        }
        let by_terms = || is_down_by_terms(&(text("formula_terms") + " " + &text("formula")));
        // Pressure rises downwards, whatever else a file says.
        let is_down = is_pressure.then_some(true).or(match &positive[..] {
            "down" => Some(true),
            "up" => Some(false),
            _ => None,
        });
        let is_down = is_down.or_else(|| is_down_by_name(&standard)).or_else(by_terms);
        let is_of_earth = is_down.is_some() || is_model_name(name);
        let by_words =
            || is_down_by_name(&name.to_lowercase()).or_else(|| is_down_by_name(&long.to_lowercase()));
        Self { kind, is_down: is_down.or_else(by_words), is_of_earth }
    }
}

/// What a name of an axis says that it is: names of models, of conventions, and of image programs. Case does not
/// matter.
pub(crate) fn kind_of_name(name: &str) -> Option<AxisKind> {
    let name = name.trim().to_lowercase();
    if name.len() > MAX_NAME_BYTES {
        return None;
    }
    let is_between = |c: char| !c.is_alphanumeric();
    let words: Vec<&str> = name
        .split(is_between)
        .map(|word| word.trim_end_matches(|c: char| c.is_ascii_digit()))
        .filter(|word| !word.is_empty())
        .collect();
    let first = *words.first()?;
    let has = |list: &[&str]| words.iter().any(|word| list.contains(word));
    let begins = |list: &[&str]| list.iter().any(|start| first.starts_with(start));
    let is_grid =
        words.len() > 1 && matches!(words.get(1), Some(&("rho" | "u" | "v" | "w" | "psi" | "vert")));
    Some(match () {
        () if has(&TIME) || ["mt", "t", "xtime"].contains(&&name[..]) => AxisKind::Time,
        () if begins(&[
            "depth", "height", "isobaric", "altitude", "olev", "sigma", "siglay", "siglev", "hybrid",
        ]) || has(&VERTICAL)
            || name.starts_with("bottom_top")
            || (first == "s" && is_grid) =>
        {
            AxisKind::Space(2)
        }
        () if has(&EAST)
            || name.starts_with("west_east")
            || (first == "xi" && (is_grid || words.len() == 1)) =>
        {
            AxisKind::Space(0)
        }
        () if has(&NORTH) || name.starts_with("south_north") || (first == "eta" && is_grid) => {
            AxisKind::Space(1)
        }
        () if has(&CHANNEL) => AxisKind::Channel,
        () => return None,
    })
}

/// The axis that a letter of `axis` names.
fn kind_of_letter(letter: &str) -> Option<AxisKind> {
    Some(match letter.trim() {
        "X" | "x" => AxisKind::Space(0),
        "Y" | "y" => AxisKind::Space(1),
        "Z" | "z" => AxisKind::Space(2),
        "T" | "t" => AxisKind::Time,
        "E" | "e" => AxisKind::Channel,
        _ => return None,
    })
}

/// Whether a unit is one of points in time, such as `hours since 2000-01-01`.
pub(super) fn is_since(units: &str) -> bool {
    units.split_whitespace().nth(1).is_some_and(|word| word.eq_ignore_ascii_case("since"))
}

/// Longitude or latitude, from a unit such as `degrees_east`.
fn kind_of_degrees(units: &str) -> Option<AxisKind> {
    let rest = units.strip_prefix("degree")?;
    let rest = rest.strip_prefix('s').unwrap_or(rest).trim_start_matches(['_', ' ']);
    Some(match &rest.to_lowercase()[..] {
        "east" | "e" => AxisKind::Space(0),
        "north" | "n" => AxisKind::Space(1),
        _ => return None,
    })
}

fn is_pressure_unit(units: &str) -> bool {
    let units = units.to_lowercase();
    let units =
        ["hecto", "kilo", "deci", "milli"].iter().find_map(|p| units.strip_prefix(p)).unwrap_or(&units);
    let units = units.strip_suffix('s').unwrap_or(units);
    ["pa", "hpa", "kpa", "pascal", "bar", "mbar", "mb", "dbar", "atm"].contains(&units)
}

/// The axis of a standard name.
fn kind_of_standard_name(name: &str) -> Option<AxisKind> {
    Some(match name {
        "" => return None,
        "longitude" | "grid_longitude" | "projection_x_coordinate" | "projection_x_angular_coordinate" => {
            AxisKind::Space(0)
        }
        "latitude" | "grid_latitude" | "projection_y_coordinate" | "projection_y_angular_coordinate" => {
            AxisKind::Space(1)
        }
        "time" | "forecast_period" | "forecast_reference_time" => AxisKind::Time,
        "realization" | "radiation_wavelength" | "sensor_band_central_radiation_wavelength" => {
            AxisKind::Channel
        }
        _ if is_down_by_name(name).is_some() || name == "model_level_number" => AxisKind::Space(2),
        _ => return None,
    })
}

/// Whether the numbers of a vertical coordinate rise downwards, from its standard name or the words of another name.
fn is_down_by_name(name: &str) -> Option<bool> {
    let has = |part: &str| name.contains(part);
    Some(match () {
        // The logarithm of a pressure is that of its inverse.
        () if has("ln_pressure") || has("log_pressure") => false,
        () if has("hybrid_height") || has("sleve") => false,
        () if has("generalized_height") => true,
        () if name.starts_with("ocean_s") || name.starts_with("ocean_double_sigma") => false,
        () if name == "ocean_layer" => true,
        () if has("pressure") || has("isobaric") || has("hybrid") || has("atmosphere_sigma") => true,
        () if has("depth") || name == "dep" || has("below") => true,
        () if ["plev", "pfull", "phalf", "pres"].iter().any(|start| name.starts_with(start)) => true,
        () if ["nav_lev", "olevel", "olev"].contains(&name) => true,
        () if ["st_ocean", "sw_ocean"].contains(&name) || name.starts_with("soil_lay") => true,
        () if has("height") || has("altitude") || has("above") => false,
        () => return None,
    })
}

/// The same from the terms of the formula that turns the coordinate into heights or pressures.
fn is_down_by_terms(terms: &str) -> Option<bool> {
    let terms = terms.to_lowercase();
    let has = |name: &str| terms.split(|c: char| !c.is_alphanumeric()).any(|word| word == name);
    Some(match () {
        // Of an ocean: the height of the surface above the bottom.
        () if has("eta") || has("zlev") => false,
        () if has("orog") || has("ztop") => false,
        () if has("ps") || has("ptop") || has("p0") || has("aps") || has("hyam") => true,
        () => return None,
    })
}

/// Whether a dimension has a name that only models of the earth use.
fn is_model_name(name: &str) -> bool {
    let name = name.to_lowercase();
    let first = name.split(|c: char| !c.is_alphanumeric()).find(|word| !word.is_empty()).unwrap_or_default();
    let first = first.trim_end_matches(|c: char| c.is_ascii_digit());
    MODEL_WORDS.contains(&first) || MODEL_STARTS.iter().any(|start| name.starts_with(start))
}

const TIME: [&str; 10] =
    ["time", "times", "date", "datetime", "reftime", "validtime", "leadtime", "timestep", "year", "month"];
const VERTICAL: [&str; 33] = [
    "z", "lev", "levs", "levels", "level", "plev", "dep", "alt", "hgt", "pressure", "pres", "vertical", "nz",
    "nk", "nlev", "k", "kz", "zl", "zi", "zt", "zw", "zu", "zc", "zf", "zlev", "zaxis", "pfull", "phalf",
    "lv", "layer", "layers", "st", "sw",
];
const EAST: [&str; 21] = [
    "x",
    "lon",
    "longitude",
    "lons",
    "nx",
    "ni",
    "i",
    "nlon",
    "xh",
    "xq",
    "xt",
    "xu",
    "xc",
    "xg",
    "xdim",
    "rlon",
    "srlon",
    "easting",
    "east",
    "col",
    "columns",
];
const NORTH: [&str; 21] = [
    "y", "lat", "latitude", "lats", "ny", "nj", "j", "nlat", "yh", "yq", "yt", "yu", "yc", "yg", "ydim",
    "rlat", "srlat", "northing", "north", "row", "rows",
];
const CHANNEL: [&str; 13] = [
    "c",
    "channel",
    "channels",
    "band",
    "bands",
    "wavelength",
    "member",
    "members",
    "ensemble",
    "ens",
    "number",
    "realization",
    "expver",
];
/// First words of names that only models of the earth use, and beginnings of such names.
const MODEL_WORDS: [&str; 24] = [
    "lat",
    "latitude",
    "nlat",
    "rlat",
    "srlat",
    "lon",
    "longitude",
    "nlon",
    "rlon",
    "srlon",
    "lev",
    "level",
    "levels",
    "plev",
    "olev",
    "olevel",
    "height",
    "altitude",
    "deptht",
    "depthu",
    "depthv",
    "depthw",
    "pfull",
    "phalf",
];
const MODEL_STARTS: [&str; 19] = [
    "west_east",
    "south_north",
    "bottom_top",
    "soil_layers",
    "xi_",
    "eta_",
    "s_rho",
    "s_w",
    "nav_l",
    "xt_ocean",
    "yt_ocean",
    "xu_ocean",
    "yu_ocean",
    "st_ocean",
    "sw_ocean",
    "grid_xt",
    "grid_yt",
    "isobaric",
    "siglay",
];
/// Longest name that is looked into.
const MAX_NAME_BYTES: usize = 256;

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    struct Words(HashMap<&'static str, &'static str>);

    impl AttributeList for Words {
        fn numbers(&self, _: &str) -> Vec<f64> {
            Vec::new()
        }

        fn text(&self, name: &str) -> Option<String> {
            self.0.get(name).map(|text| (*text).to_owned())
        }

        fn has_floats(&self, _: &str) -> bool {
            false
        }
    }

    fn words(name: &str, list: &[(&'static str, &'static str)]) -> AxisWords {
        AxisWords::of(name, Some(&Words(list.iter().copied().collect())))
    }

    #[test]
    fn every_model_names_its_axes() {
        let (x, y, z) = (AxisKind::Space(0), AxisKind::Space(1), AxisKind::Space(2));
        for (kind, names) in [
            (
                x,
                "x west_east west_east_stag xi_rho xi_u xi_psi lon longitude nav_lon nlon ni i i_g XC XG rlon xh xq xt_ocean grid_xt lon_0 g0_lon_2 easting X lon_rho",
            ),
            (
                y,
                "y south_north south_north_stag eta_rho eta_v lat latitude nav_lat nlat nj j j_g YC rlat yh yq yt_ocean grid_yt lat_0 g0_lat_1 northing Y",
            ),
            (
                z,
                "z bottom_top bottom_top_stag s_rho s_w depth deptht depthw Depth lev level levels plev isobaric isobaricInhPa lv_ISBL0 pressure_level model_level z_t z_w_top zl z_l z_i st_ocean pfull siglay olevel nav_lev height heightAboveGround altitude soil_layers_stag k k_l Z hybrid sigma nz",
            ),
            (
                AxisKind::Time,
                "time Time time_counter ocean_time reftime MT t valid_time initial_time0 forecast_time0 XTIME Times",
            ),
            (AxisKind::Channel, "c channel band member number realization ensemble expver wavelength"),
        ] {
            for name in names.split(' ') {
                assert_eq!(kind_of_name(name), Some(kind), "{name}");
            }
        }
        // The control: other words are no axes.
        for name in ["", "DateStrLen", "nv", "bnds", "cell", "station", "length", "phony_dim_0", "eta", "_"] {
            assert_eq!(kind_of_name(name), None, "{name}");
        }
    }

    #[test]
    fn attributes_count_before_names() {
        assert_eq!(words("a", &[("axis", "Z")]).kind, Some(AxisKind::Space(2)));
        assert_eq!(words("lat", &[("units", "hours since 2000-01-01")]).kind, Some(AxisKind::Time));
        assert_eq!(words("level", &[("axis", "T")]).kind, Some(AxisKind::Time));
        assert_eq!(words("a", &[("units", "degree_N")]).kind, Some(AxisKind::Space(1)));
        assert_eq!(words("a", &[("units", "degrees_east")]).kind, Some(AxisKind::Space(0)));
        assert_eq!(words("a", &[("standard_name", "grid_longitude")]).kind, Some(AxisKind::Space(0)));
        assert_eq!(words("a", &[("positive", "up")]).kind, Some(AxisKind::Space(2)));
        assert_eq!(words("a", &[("cartesian_axis", "Z")]).kind, Some(AxisKind::Space(2)));
        assert_eq!(words("a", &[("units", "m")]), AxisWords::default(), "the control");
    }

    #[test]
    fn a_vertical_coordinate_tells_its_direction() {
        for (name, list, expected) in [
            ("depth", &[("positive", "down")][..], Some(true)),
            ("depth", &[("positive", "Up")], Some(false)),
            ("level", &[("units", "millibars")], Some(true)),
            ("a", &[("units", "hPa")], Some(true)),
            ("a", &[("units", "Pa"), ("positive", "up")], Some(true)),
            ("a", &[("standard_name", "air_pressure"), ("units", "1")], Some(true)),
            ("lev", &[("standard_name", "atmosphere_hybrid_sigma_pressure_coordinate")], Some(true)),
            ("lev", &[("standard_name", "atmosphere_sigma_coordinate")], Some(true)),
            ("lev", &[("standard_name", "atmosphere_hybrid_height_coordinate")], Some(false)),
            ("lev", &[("standard_name", "atmosphere_ln_pressure_coordinate")], Some(false)),
            ("s_rho", &[("standard_name", "ocean_s_coordinate_g2")], Some(false)),
            ("sigma", &[("standard_name", "ocean_sigma_coordinate")], Some(false)),
            ("s_rho", &[("formula_terms", "s: s_rho C: Cs_r eta: zeta depth: h")], Some(false)),
            ("lev", &[("formula_terms", "a: hyam b: hybm ps: PS p0: P0")], Some(true)),
            ("lev", &[("formula_terms", "a: lev b: b orog: orog")], Some(false)),
            ("lev", &[("formula", "hyam hybm (mlev=hyam+hybm*aps)")], Some(true)),
            ("a", &[("axis", "Z"), ("long_name", "Depth of the centre")], Some(true)),
            ("deptht", &[], Some(true)),
            ("soil_layers_stag", &[], Some(true)),
            ("height", &[], Some(false)),
            ("bottom_top", &[], None),
            ("z", &[("units", "m")], None),
        ] {
            let found = words(name, list);
            assert_eq!((found.kind, found.is_down), (Some(AxisKind::Space(2)), expected), "{name} {list:?}");
        }
        // The control: what is not vertical has no such direction.
        assert_eq!(words("lat", &[("long_name", "depth")]).is_down, None);
    }

    #[test]
    fn only_the_words_of_models_make_an_axis_of_the_earth() {
        for name in ["west_east", "xi_rho", "s_rho", "lat", "level", "deptht", "isobaric3"] {
            assert!(words(name, &[]).is_of_earth, "{name}");
        }
        for name in ["x", "y", "z", "depth", "time", "length"] {
            assert!(!words(name, &[]).is_of_earth, "{name}");
        }
        assert!(words("depth", &[("positive", "down")]).is_of_earth);
    }
}

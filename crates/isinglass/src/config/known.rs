//! All settings, and the flag of each.

use clap::{Arg, Command};
use isinglass_client::Bindings;

/// A setting: `key` under `[section]`.
#[derive(Debug)]
pub(super) struct Known {
    /// The table in the file, and the first part of the variable's name.
    pub(super) section: &'static str,
    pub(super) key: &'static str,
    pub(super) arg: &'static str,
    /// The commands with this flag. The first one's file, `server.toml` or `viewer.toml`, may contain the setting.
    pub(super) commands: &'static [&'static str],
}

impl Known {
    pub(super) fn argument<'a>(&self, command: &'a Command) -> &'a Arg {
        let id = self.arg_in(command.get_name());
        command.get_arguments().find(|a| a.get_id() == id).expect("the table names flags")
    }

    /// The field of the flag. A demonstration without a window has a size of its own.
    pub(super) fn arg_in(&self, command: &str) -> &'static str {
        if command == "demo" && self.arg == "size" { "window_size" } else { self.arg }
    }

    pub(super) fn file(&self) -> &'static str {
        if self.commands[0] == "serve" { SERVER } else { VIEWER }
    }
}

const fn server(section: &'static str, key: &'static str, arg: &'static str) -> Known {
    Known { section, key, arg, commands: &["serve", "demo"] }
}

const fn serve(section: &'static str, key: &'static str, arg: &'static str) -> Known {
    Known { section, key, arg, commands: &["serve"] }
}

const fn viewer(section: &'static str, key: &'static str, arg: &'static str) -> Known {
    Known { section, key, arg, commands: &["view", "demo"] }
}

const fn view(section: &'static str, key: &'static str, arg: &'static str) -> Known {
    Known { section, key, arg, commands: &["view"] }
}

/// All settings in the order of printing. Bindings follow, whose names belong to the viewer.
pub(super) const SETTINGS: &[Known] = &[
    serve("network", "listen", "listen"),
    serve("network", "host", "host"),
    serve("network", "viewers", "viewers"),
    serve("network", "rate", "rate"),
    serve("network", "identity", "identity"),
    server("coding", "codec", "codec"),
    server("coding", "quality", "quality"),
    server("render", "backend", "backend"),
    serve("render", "gpus", "gpus"),
    server("render", "max_memory", "max_memory"),
    server("files", "foreign", "foreign_files"),
    server("look", "tf", "tf"),
    server("look", "shading", "shading"),
    server("look", "ambient_occlusion", "ambient_occlusion"),
    server("look", "occlusion_radius", "occlusion_radius"),
    server("look", "shadows", "shadows"),
    server("look", "softness", "softness"),
    server("look", "light", "light"),
    server("look", "specular", "specular"),
    server("look", "shininess", "shininess"),
    server("look", "k", "k"),
    viewer("window", "size", "size"),
    viewer("window", "fov", "fov"),
    viewer("window", "orbit", "orbit"),
    viewer("window", "bars", "bars"),
    viewer("window", "overlay", "overlay"),
    viewer("window", "axes", "axes"),
    viewer("window", "box", "volume_box"),
    viewer("window", "background", "background"),
    viewer("window", "theme", "theme"),
    viewer("window", "refresh", "refresh"),
    viewer("picture", "stereo", "stereo"),
    viewer("picture", "eye_angle", "eye_angle"),
    viewer("foresight", "predict", "predict"),
    viewer("foresight", "guard_band", "guard_band"),
    viewer("foresight", "kept_frames", "kept_frames"),
    view("remote", "ssh", "ssh"),
    view("remote", "program", "remote_program"),
];

/// The valid keys of a section, or the valid sections.
pub(super) fn expected(section: &str) -> String {
    if section == BINDINGS {
        return Bindings::names().collect::<Vec<_>>().join(", ");
    }
    let keys: Vec<_> = SETTINGS.iter().filter(|k| k.section == section).map(|k| k.key).collect();
    if keys.is_empty() {
        let mut sections: Vec<_> = SETTINGS.iter().map(|k| k.section).chain([BINDINGS]).collect();
        sections.dedup();
        return format!("one of the sections {}", sections.join(", "));
    }
    format!("one of {section}.{{{}}}", keys.join(", "))
}

pub(super) const COMMANDS: [&str; 3] = ["serve", "view", "demo"];
/// The file that `serve` reads.
pub(super) const SERVER: &str = "server.toml";
/// The file that `view` reads; `demo` reads both.
pub(super) const VIEWER: &str = "viewer.toml";
/// The viewer's section for bindings; its keys are the names of actions.
pub(super) const BINDINGS: &str = "bindings";

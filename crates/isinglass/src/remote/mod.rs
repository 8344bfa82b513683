//! Volumes on other machines: a server is started there through the user's own ssh.
//!
//! The server listens at the address by which ssh came, and its link travels through ssh. The viewer then connects to
//! the machine directly, or through ssh where it cannot. The server goes on by itself, so a session survives the end
//! of the ssh connection.

mod copy;
mod place;
mod script;
mod ssh;
mod start;

use std::sync::Arc;

use anyhow::{Result, bail};
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_client::{RemoteServer, RemoteServers};
use isinglass_core::wire::PROTOCOL_VERSION;
use isinglass_net::Link;

pub(crate) use place::RemoteVolume;
pub(crate) use script::Order;

use script::{Program, parse_program};
use ssh::Ssh;
use start::Outcome;

/// How other machines are reached.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Volumes on other machines")]
pub(crate) struct RemoteArgs {
    /// The ssh program with its options, such as "ssh -F FILE -J jump"
    #[arg(long, value_name = "COMMAND", value_parser = parse_command, default_value = "ssh")]
    ssh: SshProgram,
    /// The isinglass there [default: in the PATH, ~/.local/bin or ~/.cargo/bin]
    #[arg(long, value_name = "PROGRAM", value_parser = parse_program)]
    remote_program: Option<String>,
    /// Copy this program to ~/.local/bin there if it has none, or another version
    #[arg(long)]
    pub(crate) copy: bool,
}

/// A program and its first arguments.
#[derive(Clone, Debug)]
struct SshProgram(Vec<String>);

/// Who reads what ssh says.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Told {
    /// A person at a terminal, whom ssh may ask.
    Terminal,
    /// Nobody but the reader of the error.
    Nobody,
}

impl Told {
    fn line(&self, line: &str) {
        if let Self::Terminal = self {
            note(line);
        }
    }
}

impl RemoteArgs {
    /// Starts a server for `volume` as `order` says otherwise. ssh may ask at the terminal.
    ///
    /// # Errors
    /// One line that says on which side what is wrong.
    pub(crate) fn start(&self, volume: &RemoteVolume, order: Order) -> Result<RemoteServer> {
        self.start_told(volume, order, Told::Terminal)
    }

    fn start_told(&self, volume: &RemoteVolume, order: Order, told: Told) -> Result<RemoteServer> {
        let ssh = Ssh::new(self.ssh.0.clone(), volume, matches!(told, Told::Terminal))?;
        let machine = &volume.host;
        let order = Order { path: volume.path.clone(), program: self.remote_program.clone(), ..order };
        let mut outcome = start::start(&ssh, &order, machine, &told)?;
        if let (Outcome::Unfit(greeting), true) = (&outcome, self.copy) {
            copy::copy(&ssh, machine, &greeting.system)?;
            outcome = start::start(&ssh, &order, machine, &told)?;
        }
        let (greeting, link) = match outcome {
            Outcome::Serves(greeting, link) => (greeting, link),
            Outcome::Unfit(greeting) => bail!("{}", unfit(machine, &greeting.program, &greeting.system)),
        };
        // Only this address is listened on; a server that knows none listens on loopback.
        let address = isinglass_net::place_of(greeting.address.as_deref().unwrap_or("127.0.0.1"), link.port);
        let host = ssh.host().unwrap_or(machine).to_owned();
        let line = order.relay(&address);
        let tunnel: isinglass_net::Tunnel = Arc::new(move || ssh.quiet_command(&line));
        Ok(RemoteServer { link: Link { host, ..link }, tunnel })
    }
}

/// Why the program of a machine cannot serve this viewer, and what to do.
fn unfit(machine: &str, program: &Program, system: &str) -> String {
    let copies = match copy::difference(machine, system) {
        None => "give --copy to copy this one there".to_owned(),
        Some(difference) => difference,
    };
    let said = match program {
        Program::Missing => {
            return format!("{machine} has no isinglass in its PATH, ~/.local/bin or ~/.cargo/bin: {copies}");
        }
        Program::Broken => return format!("the isinglass on {machine} does not run: {copies}"),
        Program::Version(said) => said,
    };
    let number =
        said.split_once("(protocol ").and_then(|(_, rest)| rest.strip_suffix(')')?.parse::<u32>().ok());
    let name = isinglass_core::text::printable(said.split(" (").next().unwrap_or_default(), 40);
    match number {
        Some(number) if number > PROTOCOL_VERSION => format!(
            "{machine} has {name}, which speaks protocol version {number}, and this viewer {PROTOCOL_VERSION}: update this viewer"
        ),
        number => {
            let number =
                number.map_or("an older protocol version".into(), |n| format!("protocol version {n}"));
            format!(
                "{machine} has {name}, which speaks {number}, and this viewer {PROTOCOL_VERSION}: update isinglass there, or {copies}"
            )
        }
    }
}

/// The window starts servers too. It has no terminal, so ssh must not ask.
impl RemoteServers for RemoteArgs {
    fn is_place(&self, text: &str) -> bool {
        RemoteVolume::parse(text).is_some()
    }

    fn start(&self, place: &str) -> Result<RemoteServer, String> {
        let volume = RemoteVolume::parse(place).ok_or("expected host:/path")??;
        let started = self.start_told(&volume, Order::default(), Told::Nobody);
        started.map_err(|e| format!("{e:#}"))
    }
}

fn parse_command(text: &str) -> Result<SshProgram, String> {
    let words = shlex::split(text).filter(|words| words.first().is_some_and(|name| !name.is_empty()));
    words.map(SshProgram).ok_or_else(|| "expected a program and its options, such as \"ssh -F FILE\"".into())
}

/// The flags of `given` that `serve` takes too, and the text of a transfer function that is a file of this machine.
pub(crate) fn order(given: &crate::given::Given, transfer: Option<&str>) -> Result<Order> {
    let mut order = Order::default();
    for field in OF_SERVER {
        let value = given.text(field);
        let file = (*field == "tf").then_some(transfer).flatten().map(std::path::Path::new);
        match (value, file.filter(|file| file.is_file())) {
            (Some(name), Some(file)) if isinglass_formats::preset(name).is_none() => {
                let text = isinglass_formats::read_text(file, isinglass_formats::MAX_TRANSFER_BYTES)?;
                let name = file.file_name().unwrap_or_default().to_string_lossy();
                order.transfer = Some((name.into_owned(), text));
            }
            (Some(value), _) => order.flags.push(format!("--{}={value}", field.replace('_', "-"))),
            (None, _) => {}
        }
    }
    Ok(order)
}

/// The flags of `view` that belong to a server, by the names of their fields.
const OF_SERVER: &[&str] = &[
    "backend",
    "max_memory",
    "k",
    "tf",
    "shading",
    "mode",
    "iso",
    "clip_box",
    "clip_plane",
    "ambient_occlusion",
    "occlusion_radius",
    "shadows",
    "softness",
    "light",
    "specular",
    "shininess",
    "dims",
    "dtype",
    "endian",
    "offset",
    "channel",
    "time",
    "level",
    "series",
    "region",
    "flip",
    "spacing",
    "foreign_files",
    "stored_slices",
    "voxels",
    "thin",
    "labels",
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_flag_that_both_commands_have_goes_to_the_server() {
        let command = crate::command();
        let of = |name: &str| -> BTreeSet<(String, String)> {
            let flags = command.find_subcommand(name).unwrap().get_arguments();
            let flag = |a: &clap::Arg| Some((a.get_id().to_string(), a.get_long()?.to_owned()));
            flags.filter_map(flag).collect()
        };
        let (view, serve) = (of("view"), of("serve"));
        let own = ["state", "config", "print_config", "json"];
        let both: BTreeSet<_> =
            view.intersection(&serve).filter(|(id, _)| !own.contains(&id.as_str())).collect();
        assert_eq!(
            both.iter().map(|(id, _)| id.as_str()).collect::<BTreeSet<_>>(),
            OF_SERVER.iter().copied().collect()
        );
        for (id, long) in both {
            assert_eq!(*long, id.replace('_', "-"));
        }
    }

    #[test]
    fn who_has_to_update_is_said() {
        let system = "Plan9 mips";
        let line = |program| unfit("gpu", &program, system);
        assert!(
            line(Program::Missing).contains("gpu has no isinglass")
                && line(Program::Missing).contains("Plan9")
        );
        assert!(line(Program::Broken).contains("does not run"));
        let newer = line(Program::Version("isinglass 9.0 (protocol 99)".into()));
        assert!(
            newer.contains("isinglass 9.0")
                && newer.contains("version 99")
                && newer.contains("update this viewer"),
            "{newer}"
        );
        for (said, number) in [("isinglass 0.1 (protocol 3)", "version 3"), ("isinglass 0.1", "older")] {
            let older = line(Program::Version(said.into()));
            assert!(older.contains(number) && older.contains("update isinglass there"), "{older}");
            assert!(older.contains(&PROTOCOL_VERSION.to_string()), "{older}");
        }
    }

    #[test]
    fn a_command_may_have_quotes() {
        assert_eq!(parse_command("ssh -F 'a b' -v").unwrap().0, ["ssh", "-F", "a b", "-v"]);
        for bad in ["", "  ", "ssh 'a", "''"] {
            assert!(parse_command(bad).is_err(), "{bad}");
        }
    }
}

//! What runs on the other machine: a script for its POSIX shell.
//!
//! It travels on standard input, so the login shell there, which may be fish or csh, reads only the word that starts
//! the POSIX shell. Nothing in it appears in a list of processes but what `serve` itself is given.

use anyhow::{Context, Result};
use isinglass_core::wire::PROTOCOL_VERSION;

/// Starts the POSIX shell that reads a script. Every login shell understands it.
pub(super) const SHELL: &str = "exec /bin/sh";

/// What to serve there, and how.
#[derive(Clone, Debug, Default)]
pub(crate) struct Order {
    /// The program there; `None` if its shell finds it.
    pub(crate) program: Option<String>,
    /// The volume.
    pub(super) path: String,
    /// Flags for `serve`.
    pub(crate) flags: Vec<String>,
    /// Name and text of a transfer function of this machine.
    pub(crate) transfer: Option<(String, String)>,
}

/// The answer before the server's own output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Greeting {
    /// The kind of the machine, as `uname -sm` tells it.
    pub(super) system: String,
    /// Its address by which ssh came.
    pub(super) address: Option<String>,
    pub(super) program: Program,
}

/// The isinglass of the other machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Program {
    Missing,
    /// It is there and does not run.
    Broken,
    /// Its `--version`.
    Version(String),
}

impl Order {
    /// The script. It says that it has begun, greets, and serves if the program there speaks this protocol.
    pub(super) fn script(&self) -> Result<String> {
        let program = self.program();
        let path = match self.path.strip_prefix("~/") {
            Some(rest) => format!("\"$HOME\"/{}", quoted(rest)?),
            None => quoted(&self.path)?,
        };
        let mut flags = self.flags.iter().map(|flag| quoted(flag)).collect::<Result<Vec<_>>>()?.join(" ");
        let mut before = String::new();
        if let Some((name, text)) = &self.transfer {
            let name = quoted(name)?;
            before = format!(
                "d=$(mktemp -d) || exit 1\ntrap 'rm -rf \"$d\"' EXIT\nprintf %s {} > \"$d\"/{name} || exit 1\n",
                quoted(text)?
            );
            flags += &format!(" --tf \"$d\"/{name}");
        }
        Ok(format!(
            "echo {BEGUN}
{PATHS}p={program}
if command -v \"$p\" >/dev/null 2>&1; then v=$(\"$p\" --version </dev/null) || v=broken; else v=missing; fi
set -- $SSH_CONNECTION
echo \"{GREETING}|$(uname -sm)|$3|$v\"
case $v in *'(protocol {PROTOCOL_VERSION})') ;; *) exit 0;; esac
case $3 in '') a=127.0.0.1:0;; *%*) a='[::]:0';; *:*) a=\"[$3]:0\";; *) a=\"$3:0\";; esac
{before}\"$p\" serve --detach --end-after-last 60s --listen \"$a\" {flags} -- {path} </dev/null
"
        ))
    }

    /// A line for any login shell that joins its standard input and output with the server at `address`.
    pub(super) fn relay(&self, address: &str) -> String {
        // No quote, backslash or ! is inside, which shells read differently.
        format!("exec /bin/sh -c '{} p={}; exec \"$p\" relay {address}'", PATHS.trim_end(), self.program())
    }

    fn program(&self) -> &str {
        self.program.as_deref().unwrap_or("isinglass")
    }
}

impl Greeting {
    /// Whether the program there speaks this protocol, so that the script starts it.
    pub(super) fn is_fit(&self) -> bool {
        let end = format!("(protocol {PROTOCOL_VERSION})");
        matches!(&self.program, Program::Version(said) if said.ends_with(&end))
    }

    /// Reads a line; `None` for what the login shell prints by itself.
    pub(super) fn of(line: &str) -> Option<Self> {
        let mut fields = line.trim_end().strip_prefix(GREETING)?.strip_prefix('|')?.splitn(3, '|');
        let (system, address, version) = (fields.next()?, fields.next()?, fields.next()?);
        let program = match version {
            "missing" => Program::Missing,
            "broken" => Program::Broken,
            version => Program::Version(version.to_owned()),
        };
        let is_address = address.parse::<std::net::IpAddr>().is_ok();
        Some(Self { system: system.into(), address: is_address.then(|| address.into()), program })
    }
}

/// Reads the name of the program there, which stands in scripts as it is.
///
/// # Errors
/// If a shell would read more than a name in it.
pub(crate) fn parse_program(text: &str) -> Result<String, String> {
    let is_char = |c: char| c.is_ascii_alphanumeric() || "/._+-".contains(c);
    let name = text.strip_prefix("~/").unwrap_or(text);
    match !name.is_empty() && !name.starts_with('-') && name.chars().all(is_char) {
        true => Ok(text.to_owned()),
        false => Err("expected a path of letters, digits and /._+-".into()),
    }
}

fn quoted(text: &str) -> Result<String> {
    Ok(shlex::try_quote(text).context("a name or a file with a zero byte")?.into_owned())
}

/// Where programs are that a person has installed, beside where the system has them. What `--copy` copies goes first.
const PATHS: &str = "PATH=\"$HOME/.local/bin:$PATH:$HOME/.cargo/bin\"; export PATH;\n";
/// The line that says that the script has begun: from now on, nobody is asked for a password.
pub(super) const BEGUN: &str = "isinglass-begun";
/// The first word of the line that tells about the machine.
const GREETING: &str = "isinglass-there";

#[cfg(unix)]
#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;
    use std::process::{Command, Stdio};

    use super::*;

    /// A home folder with an isinglass that tells its arguments, each on a line.
    fn home(version: &str) -> tempfile::TempDir {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join(".local/bin");
        std::fs::create_dir_all(&folder).unwrap();
        let program = folder.join("isinglass");
        let text = format!(
            "#!/bin/sh\nif [ \"$1\" = --version ]; then echo '{version}'; exit; fi\nfor a; do echo \"$a\"; case $a in */tf.toml) \
             cat \"$a\";; esac; done\n"
        );
        std::fs::write(&program, text).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        home
    }

    /// What the script prints where a login shell starts the POSIX shell.
    fn run(login: &[&str], home: &Path, connection: &str, script: &str) -> Vec<String> {
        let mut command = Command::new(login[0]);
        command.args(&login[1..]).env("HOME", home).env("SSH_CONNECTION", connection).current_dir(home);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(script.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        let lines = String::from_utf8(output.stdout).unwrap();
        lines.lines().filter(|line| *line != BEGUN).map(str::to_owned).collect()
    }

    fn version() -> String {
        format!("isinglass 0.1.0 (protocol {PROTOCOL_VERSION})")
    }

    fn order(path: &str) -> Order {
        Order { path: path.into(), ..Order::default() }
    }

    #[test]
    fn any_path_reaches_the_server_as_it_is() {
        let home = home(&version());
        for path in
            ["/data/a b.nrrd", "it's \"$HOME\" `x` \\ !! %d", "-x", "a\nb", "µ*?[a]", "builtin:cloud", "~x"]
        {
            let script = order(path).script().unwrap();
            let said = run(&["/bin/sh"], home.path(), "192.0.2.1 5 198.51.100.7 22", &script);
            let greeting = Greeting::of(&said[0]).unwrap();
            assert_eq!(greeting.address.as_deref(), Some("198.51.100.7"));
            assert_eq!(greeting.program, Program::Version(version()));
            let given = said[1..].join("\n");
            assert_eq!(
                given,
                format!("serve\n--detach\n--end-after-last\n60s\n--listen\n198.51.100.7:0\n--\n{path}")
            );
        }
        let said = run(&["/bin/sh"], home.path(), "", &order("~/a b").script().unwrap());
        assert_eq!(said.last().unwrap(), &format!("{}/a b", home.path().display()));
        assert_eq!(said[6], "127.0.0.1:0", "no way to this machine is known");
        assert!(order("a\0b").script().is_err());
    }

    #[test]
    fn an_address_of_any_kind_is_listened_on() {
        let home = home(&version());
        for (address, listened) in
            [("2001:db8::1", "[2001:db8::1]:0"), ("fe80::1%eth0", "[::]:0"), ("10.0.0.1", "10.0.0.1:0")]
        {
            let connection = format!("::1 5 {address} 22");
            assert_eq!(
                run(&["/bin/sh"], home.path(), &connection, &order("a").script().unwrap())[6],
                listened
            );
        }
    }

    #[test]
    fn flags_and_a_transfer_function_of_this_machine_go_with_it() {
        let home = home(&version());
        let transfer = Some(("tf.toml".to_owned(), "a = 'b'\n\"$c\"\n".to_owned()));
        let flags = vec!["--clip-plane=-1,0,0,2".to_owned(), "--tf=it's".to_owned()];
        let script = Order { flags, transfer, ..order("a") }.script().unwrap();
        let said = run(&["/bin/sh"], home.path(), "", &script);
        assert_eq!(said[7..10], ["--clip-plane=-1,0,0,2", "--tf=it's", "--tf"]);
        assert_eq!(said[11..], ["a = 'b'", "\"$c\"", "--", "a"]);
        assert!(!Path::new(&said[10]).exists(), "the copy is gone with the script");
    }

    #[test]
    fn only_a_program_of_this_protocol_serves() {
        let said = |home: &Path, order: Order| run(&["/bin/sh"], home, "", &order.script().unwrap());
        let program = |said: &[String]| Greeting::of(&said[0]).unwrap().program;
        for other in ["isinglass 0.1.0", "isinglass 9.0.0 (protocol 99)"] {
            let said = said(home(other).path(), order("a"));
            assert_eq!((said.len(), program(&said)), (1, Program::Version(other.into())));
        }
        let empty = tempfile::tempdir().unwrap();
        let missing = Order { program: Some("~/no/isinglass".into()), ..order("a") };
        let missing = said(empty.path(), missing);
        assert_eq!((missing.len(), program(&missing)), (1, Program::Missing));
        std::fs::create_dir_all(empty.path().join(".local/bin")).unwrap();
        let file = empty.path().join(".local/bin/isinglass");
        std::fs::write(&file, "#!/bin/sh\nexit 3\n").unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
        assert_eq!(program(&said(empty.path(), order("a"))), Program::Broken);
    }

    #[test]
    fn other_login_shells_start_it_too() {
        let home = home(&version());
        let script = order("it's").script().unwrap();
        let relay =
            Order { program: Some("~/.local/bin/isinglass".into()), ..order("a") }.relay("[::1]:4433");
        for shell in ["/bin/sh", "/bin/bash", "/usr/bin/fish", "/bin/csh", "/usr/bin/zsh"] {
            if !Path::new(shell).exists() {
                eprintln!("skipped: there is no {shell}");
                continue;
            }
            let said = run(&[shell, "-c", SHELL], home.path(), "", &script);
            assert_eq!(said.last().map(String::as_str), Some("it's"), "{shell}");
            assert_eq!(run(&[shell, "-c", &relay], home.path(), "", ""), ["relay", "[::1]:4433"], "{shell}");
        }
    }

    #[test]
    fn what_a_shell_prints_by_itself_is_no_greeting() {
        for line in ["", "Welcome!", "isinglass-there", "isinglass-there|a|b", " isinglass-there|a|b|c"] {
            assert_eq!(Greeting::of(line), None, "{line}");
        }
        let odd = Greeting::of("isinglass-there|Linux x86_64|not an address|missing").unwrap();
        assert_eq!((odd.address, odd.program), (None, Program::Missing));
        assert!(parse_program("/opt/isinglass-2/bin/isinglass").is_ok() && parse_program("~/bin/x").is_ok());
        for bad in ["", "-x", "a b", "$(x)", "a;b", "~/", "~me/x", "'"] {
            assert!(parse_program(bad).is_err(), "{bad}");
        }
    }
}

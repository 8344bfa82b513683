//! The user's own ssh program, called so that one connection serves all commands to a machine.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, Result};
use tempfile::TempDir;

use super::place::RemoteVolume;

/// How to reach one machine. Dropping it closes the connection that its commands share.
pub(crate) struct Ssh {
    program: Vec<String>,
    destination: String,
    port: Option<u16>,
    /// What ssh's configuration says about the machine.
    known: SshConfig,
    /// The folder of the socket by which later commands use the first one's connection.
    shared: Option<TempDir>,
    /// Whether ssh may ask at a terminal.
    may_ask: bool,
}

/// What `ssh -G` says.
#[derive(Debug, Default, PartialEq)]
struct SshConfig {
    /// Name or address of the machine.
    host: Option<String>,
    /// Whether connections are shared already.
    is_shared: bool,
    has_timeout: bool,
}

impl Ssh {
    /// Asks `program` for its configuration of the machine. Nothing is connected yet.
    ///
    /// # Errors
    /// If there is no such program.
    pub(crate) fn new(program: Vec<String>, volume: &RemoteVolume, may_ask: bool) -> Result<Self> {
        let mut ssh = Self {
            program,
            destination: volume.destination(),
            port: volume.port,
            known: SshConfig::default(),
            shared: None,
            may_ask,
        };
        let mut command = ssh.plain();
        let asked =
            command.arg("-G").arg(&ssh.destination).stdin(Stdio::null()).stderr(Stdio::null()).output();
        let name = &ssh.program[0];
        let answer =
            asked.with_context(|| format!("cannot run {name}; install OpenSSH, or name it with --ssh"))?;
        // Another program than OpenSSH may not know the question.
        if answer.status.success() {
            ssh.known = SshConfig::of(&String::from_utf8_lossy(&answer.stdout));
            if cfg!(unix) && !ssh.known.is_shared {
                ssh.shared = folder_for_socket();
            }
        }
        Ok(ssh)
    }

    /// Name or address of the machine, by which packets may reach it directly.
    pub(super) fn host(&self) -> Option<&str> {
        self.known.host.as_deref()
    }

    /// Whether ssh may ask for a password.
    pub(super) fn may_ask(&self) -> bool {
        self.may_ask
    }

    /// Runs `line` in the machine's login shell, whichever that is.
    pub(super) fn command(&self, line: &str) -> Command {
        self.connecting(self.may_ask, line)
    }

    /// The same for a viewer that is running already, and asks nothing.
    pub(super) fn quiet_command(&self, line: &str) -> Command {
        self.connecting(self.may_ask && self.shared.is_none() && !self.known.is_shared, line)
    }

    fn connecting(&self, may_ask: bool, line: &str) -> Command {
        let mut command = self.plain();
        command.arg("-T");
        let mut option = |text: &str| {
            command.args(["-o", text]);
        };
        option("RemoteCommand=none");
        option("ClearAllForwardings=yes");
        // A connection that has died must not keep the next command waiting.
        option("ServerAliveInterval=5");
        option("ServerAliveCountMax=3");
        if !self.known.has_timeout {
            option("ConnectTimeout=20");
        }
        if !may_ask {
            option("BatchMode=yes");
        }
        if let Some(socket) = self.socket() {
            option("ControlMaster=auto");
            option(&format!("ControlPath={}", socket.display()));
            option("ControlPersist=60");
        }
        command.args([&self.destination, line]);
        command
    }

    fn plain(&self) -> Command {
        let mut command = Command::new(&self.program[0]);
        command.args(&self.program[1..]);
        if let Some(port) = self.port {
            command.args(["-p", &port.to_string()]);
        }
        command
    }

    fn socket(&self) -> Option<PathBuf> {
        self.shared.as_ref().map(|folder| folder.path().join("s"))
    }
}

impl Drop for Ssh {
    fn drop(&mut self) {
        if let Some(socket) = self.socket().filter(|socket| socket.exists()) {
            let mut command = self.plain();
            command.args([
                "-o",
                &format!("ControlPath={}", socket.display()),
                "-O",
                "exit",
                &self.destination,
            ]);
            let quiet = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            let _ = quiet.status();
        }
    }
}

impl SshConfig {
    fn of(answer: &str) -> Self {
        let value = |key: &str| {
            let line = answer.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(' '));
            line.map(str::trim).filter(|value| !value.is_empty() && *value != "none")
        };
        Self {
            host: value("hostname").map(str::to_owned),
            is_shared: value("controlpath").is_some() && value("controlmaster").is_some_and(|v| v != "false"),
            has_timeout: value("connecttimeout").is_some(),
        }
    }
}

/// A folder of this user alone, with a short name, because names of sockets are short.
fn folder_for_socket() -> Option<TempDir> {
    let folder = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|path| path.is_dir());
    let mut builder = tempfile::Builder::new();
    builder.prefix("isinglass-");
    // Whoever reaches the socket reaches the machine as this user.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o700));
    let made = builder.tempdir_in(folder.unwrap_or_else(std::env::temp_dir)).ok()?;
    let name = made.path().to_str()?;
    // ssh reads a value of its options up to a blank, and puts names in place of a %.
    let is_good = name.len() <= MOST_BYTES_OF_FOLDER && !name.contains([' ', '%', '"']);
    is_good.then_some(made)
}

/// What is left of the 104 bytes that systems give to a socket's name, beside what ssh puts behind.
const MOST_BYTES_OF_FOLDER: usize = 80;

#[cfg(test)]
mod tests {
    use super::*;

    fn arguments(command: &Command) -> Vec<String> {
        command.get_args().map(|a| a.to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn the_configuration_is_read() {
        let answer = "host gpu\nhostname gpu.example.org\nport 22\nconnecttimeout none\ncontrolpath none\n";
        let host = Some("gpu.example.org".to_owned());
        assert_eq!(
            SshConfig::of(answer),
            SshConfig { host: host.clone(), is_shared: false, has_timeout: false }
        );
        let answer = answer.replace("none", "7") + "controlmaster auto\n";
        assert_eq!(SshConfig::of(&answer), SshConfig { host, is_shared: true, has_timeout: true });
        assert_eq!(SshConfig::of("no such option\n"), SshConfig::default());
    }

    #[cfg(unix)]
    #[test]
    fn the_folder_of_the_socket_is_this_users_alone() {
        let folder = folder_for_socket().unwrap();
        let mode = std::os::unix::fs::PermissionsExt::mode(&folder.path().metadata().unwrap().permissions());
        assert_eq!(mode & 0o777, 0o700);
        // The control: a folder is open to others by default.
        let usual = folder.path().join("usual");
        std::fs::create_dir(&usual).unwrap();
        let mode = std::os::unix::fs::PermissionsExt::mode(&usual.metadata().unwrap().permissions());
        assert_ne!(mode & 0o077, 0, "this machine's umask closes all folders");
    }

    #[test]
    fn a_running_viewer_asks_nothing_if_the_connection_is_shared() {
        let ssh = |shared, may_ask| Ssh {
            program: vec!["ssh".into(), "-F".into(), "a b".into()],
            destination: "me@gpu".into(),
            port: Some(2222),
            known: SshConfig::default(),
            shared,
            may_ask,
        };
        let asks = |command: &Command| !arguments(command).contains(&"BatchMode=yes".to_owned());
        let alone = ssh(None, true);
        assert!(asks(&alone.command("x")) && asks(&alone.quiet_command("x")));
        let shared = ssh(folder_for_socket(), true);
        assert!(asks(&shared.command("x")) && !asks(&shared.quiet_command("x")));
        assert!(!asks(&ssh(None, false).command("x")));
        let arguments = arguments(&shared.command("exec /bin/sh"));
        assert_eq!(arguments[..4], ["-F", "a b", "-p", "2222"]);
        assert_eq!(arguments[arguments.len() - 2..], ["me@gpu", "exec /bin/sh"]);
        assert!(arguments.iter().any(|a| a.starts_with("ControlPath=")));
    }
}

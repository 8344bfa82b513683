//! A real sshd on loopback, with keys and a home folder of its own.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::{Bench, Running};

/// See the module. It ends with this.
pub(crate) struct Sshd {
    process: Running,
    port: u16,
    home: PathBuf,
    /// The configuration of ssh that leads to it.
    config: PathBuf,
}

impl Sshd {
    /// Starts one in the bench's folder. In its home, `~/.local/bin` has this program if `has_program`.
    pub(crate) fn start(bench: &Bench, has_program: bool) -> Self {
        let folder = bench.path("sshd");
        let home = folder.join("home");
        fs::create_dir_all(home.join(".local/bin")).unwrap();
        if has_program {
            symlink(env!("CARGO_BIN_EXE_isinglass"), home.join(".local/bin/isinglass")).unwrap();
        }
        let [host_key, key, other] = ["host", "key", "other"].map(|name| make_key(&folder.join(name)));
        fs::copy(key.with_extension("pub"), folder.join("authorized")).unwrap();
        // sshd wants this folder of root's; elsewhere it does not ask.
        let _ = fs::create_dir_all("/run/sshd");
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let settings = format!(
            "Port {port}\nListenAddress 127.0.0.1\nHostKey {}\nPidFile none\nAuthorizedKeysFile {}\nStrictModes no\nUsePAM no\n\
             PasswordAuthentication no\nKbdInteractiveAuthentication no\nPermitRootLogin yes\nPrintMotd no\n\
             SetEnv HOME={} PATH=/usr/local/bin:/usr/bin:/bin ISINGLASS_SYSTEM_CONFIG=/none\n",
            host_key.display(),
            folder.join("authorized").display(),
            home.display(),
        );
        let settings = bench.write("sshd/settings", settings);
        let mut command = Command::new(SSHD);
        command.arg("-D").arg("-e").arg("-f").arg(settings).stdin(Stdio::null());
        let process = Running(command.stderr(fs::File::create(folder.join("log")).unwrap()).spawn().unwrap());
        let host_key = fs::read_to_string(host_key.with_extension("pub")).unwrap();
        let known = format!("[127.0.0.1]:{port} {host_key}");
        let known = bench.write("sshd/known", known);
        let user = String::from_utf8(Command::new("id").arg("-un").output().unwrap().stdout).unwrap();
        let all = format!(
            "HostName 127.0.0.1\nUser {user}\nIdentitiesOnly yes\nIdentityAgent none\n\
             UserKnownHostsFile {}\nGlobalKnownHostsFile none\nStrictHostKeyChecking yes\n",
            known.display()
        );
        let config = bench.path("sshd/config");
        let own = format!(
            "Host there\nPort {port}\n\nHost jumped\nPort {port}\nProxyJump there\n\n\
             # Its name is known behind the jump host only, so nothing but ssh reaches it.\n\
             Host behind\nHostName behind.invalid\nHostKeyAlias [127.0.0.1]:{port}\n\
             ProxyCommand ssh -F {} -W 127.0.0.1:{port} there\n\n\
             Host keyless\nPort {port}\nIdentityFile {}\n\n\
             # Names of keys add up.\nHost !keyless *\nIdentityFile {}\n\nHost stranger\nPort {port}\nUserKnownHostsFile none\n\n\
             Host closed\nPort 1\n\nHost nowhere\nHostName nowhere.invalid\n\nHost *\n{all}",
            config.display(),
            other.display(),
            key.display(),
        );
        fs::write(&config, own).unwrap();
        let sshd = Self { process, port, home, config };
        sshd.wait_until_it_listens();
        sshd
    }

    fn wait_until_it_listens(&self) {
        let patience = Instant::now() + Duration::from_secs(30);
        while TcpStream::connect(("127.0.0.1", self.port)).is_err() {
            assert!(Instant::now() < patience, "sshd does not listen");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The command that leads to it.
    pub(crate) fn ssh(&self) -> String {
        format!("ssh -F {}", self.config.display())
    }

    /// The home folder of who logs in.
    pub(crate) fn home(&self) -> &Path {
        &self.home
    }

    /// Ends it and all its connections.
    pub(crate) fn end(&mut self) {
        for process in fs::read_dir("/proc").unwrap() {
            let process = process.unwrap();
            let Ok(stat) = fs::read_to_string(process.path().join("stat")) else { continue };
            let parent = stat.rsplit(") ").next().and_then(|fields| fields.split(' ').nth(1)?.parse().ok());
            if parent == Some(self.process.0.id()) {
                Command::new("kill").arg("-KILL").arg(process.file_name()).status().unwrap();
            }
        }
        let _ = self.process.0.kill();
        let _ = self.process.0.wait();
    }
}

fn make_key(path: &Path) -> PathBuf {
    let made = Command::new("ssh-keygen").args(["-q", "-t", "ed25519", "-N", "", "-f"]).arg(path).status();
    assert!(made.unwrap().success());
    fs::set_permissions(path, fs::Permissions::from_mode(0o600)).unwrap();
    path.to_owned()
}

/// Whether this machine has what the tests need. Strict mode fails without.
pub(crate) fn has_sshd() -> bool {
    let has =
        Path::new(SSHD).exists() && Command::new("ssh").arg("-V").stderr(Stdio::null()).status().is_ok();
    let is_strict = std::env::var("ISINGLASS_STRICT").as_deref() == Ok("1");
    assert!(has || !is_strict, "there is no {SSHD} or no ssh; Debian's package is openssh-server");
    if !has {
        eprintln!("skipped: there is no {SSHD} or no ssh");
    }
    has
}

const SSHD: &str = "/usr/sbin/sshd";

//! One try to start a server on another machine, and what comes back.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ExitStatus, Stdio};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use isinglass_core::text::printable;
use isinglass_net::Link;

use super::Told;
use super::script::{BEGUN, Greeting, Order, SHELL};
use super::ssh::Ssh;

/// How a try ended that reached the machine.
pub(super) enum Outcome {
    /// A server serves, and this link as it knows itself lets in one viewer.
    Serves(Greeting, Link),
    /// No server was started: the program there is missing, or another one.
    Unfit(Greeting),
}

/// Starts a server. `machine` is the other machine's name for messages, and `told` gets what ssh and the server say.
///
/// # Errors
/// One line: ssh did not reach the machine, or the server there failed.
pub(super) fn start(ssh: &Ssh, order: &Order, machine: &str, told: &Told) -> Result<Outcome> {
    let script = order.script()?;
    let mut command = ssh.command(SHELL);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().context("cannot run ssh")?;
    if let Some(mut stdin) = child.stdin.take() {
        // A long script waits until ssh has read it. If ssh ends first, its status says more.
        thread::spawn(move || stdin.write_all(script.as_bytes()));
    }
    let complaints = Complaints::listen(&mut child, told);
    let stdout = child.stdout.take().context("no output of ssh")?;
    let Answer { greeting, link, is_late } = answer(stdout, GREETING_TIME, |greeting| {
        if greeting.is_fit() {
            told.line(&format!("{machine} reads the volume …"));
        }
    });
    if is_late {
        let _ = child.kill();
        let _ = child.wait();
        let seconds = GREETING_TIME.as_secs();
        bail!("the isinglass on {machine} does not answer `isinglass --version` within {seconds} s");
    }
    if let (Some(greeting), Some(link)) = (&greeting, link) {
        // ssh ends by itself, as the server there lets it go.
        thread::spawn(move || child.wait());
        let link = link.parse().with_context(|| format!("the link of the server on {machine}"))?;
        return Ok(Outcome::Serves(greeting.clone(), link));
    }
    let status = child.wait().context("ssh")?;
    let Heard { complaint, last } = complaints.end();
    match greeting {
        Some(greeting) if status.success() && complaint.is_none() && !greeting.is_fit() => {
            Ok(Outcome::Unfit(greeting))
        }
        Some(_) => match complaint {
            Some(complaint) => bail!("{machine}: {complaint}"),
            None => {
                bail!("the server on {machine} has ended before it printed its link{}", shown(last, told))
            }
        },
        None => bail!("{}", unreached(ssh, machine, status, last, told)),
    }
}

/// What comes from the other machine.
struct Answer {
    greeting: Option<Greeting>,
    link: Option<String>,
    /// Whether the greeting did not follow in time. Then the rest was not waited for.
    is_late: bool,
}

/// Reads the greeting and the link; neither is there if the output ends before. Between the begin of the script and the
/// greeting, `patience` may pass.
fn answer(stdout: impl Read + Send + 'static, patience: Duration, greeted: impl Fn(&Greeting)) -> Answer {
    let (sender, lines) = mpsc::sync_channel(0);
    thread::spawn(move || {
        for line in BufReader::new(stdout.take(MOST_BYTES)).split(b'\n').map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    let mut found = Answer { greeting: None, link: None, is_late: false };
    let mut has_begun = false;
    while found.link.is_none() {
        let next = match has_begun && found.greeting.is_none() {
            true => lines.recv_timeout(patience),
            false => lines.recv().map_err(RecvTimeoutError::from),
        };
        let line = match next {
            Ok(line) => line,
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {
                found.is_late = true;
                break;
            }
        };
        let line = String::from_utf8_lossy(&line);
        has_begun |= line.trim_end() == BEGUN;
        match &found.greeting {
            None => found.greeting = Greeting::of(&line).inspect(&greeted),
            Some(_) => {
                found.link = Some(line.trim()).filter(|l| l.starts_with("isinglass://")).map(str::to_owned);
            }
        }
    }
    found
}

/// Why ssh has not started anything.
fn unreached(ssh: &Ssh, machine: &str, status: ExitStatus, last: Option<String>, told: &Told) -> String {
    match status.code() {
        Some(OF_SSH) => {
            let hint = match ssh.may_ask() {
                true => "",
                false => "; if it would ask for something, use a terminal: isinglass view host:/path",
            };
            format!("ssh does not reach {machine}{}{hint}", shown(last, told))
        }
        _ => format!("{machine} starts no /bin/sh ({status}){}", shown(last, told)),
    }
}

/// What ssh said last, or that it is on the terminal.
fn shown(last: Option<String>, told: &Told) -> String {
    match (last, told) {
        (None, _) => String::new(),
        (Some(_), Told::Terminal) => "; its message is above".into(),
        (Some(line), Told::Nobody) => format!(": {line}"),
    }
}

/// What ssh and the server there write to standard error.
pub(super) struct Complaints {
    heard: Arc<Mutex<Heard>>,
    /// Disconnected at the end.
    ended: mpsc::Receiver<()>,
}

#[derive(Default)]
pub(super) struct Heard {
    /// The server's own error.
    complaint: Option<String>,
    /// The last line of others.
    last: Option<String>,
}

impl Complaints {
    /// Passes on what comes, but for the server's own error.
    pub(super) fn listen(child: &mut Child, told: &Told) -> Self {
        let (at_end, ended) = mpsc::sync_channel(0);
        let heard = Arc::<Mutex<Heard>>::default();
        let (told, stderr, hears) = (*told, child.stderr.take(), heard.clone());
        thread::spawn(move || {
            let _at_end: mpsc::SyncSender<()> = at_end;
            for line in
                stderr.into_iter().flat_map(|stderr| BufReader::new(stderr.take(MOST_BYTES)).split(b'\n'))
            {
                let Ok(line) = line else { break };
                // A machine that one does not trust yet must not rewrite the terminal.
                let line = printable(&String::from_utf8_lossy(&line), LONGEST_LINE);
                let line = line.trim();
                let mut heard = hears.lock().unwrap_or_else(PoisonError::into_inner);
                match line.strip_prefix("isinglass: ") {
                    Some(of_server) => heard.complaint = Some(of_server.to_owned()),
                    None if line.is_empty() => {}
                    None => {
                        told.line(line);
                        heard.last = Some(line.to_owned());
                    }
                }
            }
        });
        Self { heard, ended }
    }

    /// What was heard. A process that goes on in the background may hold standard error open, so the end is not waited
    /// for long.
    pub(super) fn end(self) -> Heard {
        let _ = self.ended.recv_timeout(PATIENCE);
        std::mem::take(&mut *self.heard.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The exit status by which ssh tells of its own failure.
const OF_SSH: i32 = 255;
/// Most bytes of output up to the link, and of complaints. What a login shell prints comes before.
const MOST_BYTES: u64 = 1 << 20;
/// Longest line that is shown, in characters.
const LONGEST_LINE: usize = 500;
/// Time in which a program tells its version, also from a slow disk.
const GREETING_TIME: Duration = Duration::from_secs(30);
/// Time for the last lines of an ended process to arrive.
const PATIENCE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::super::script::Program;
    use super::*;

    #[test]
    fn the_answer_is_found_among_other_lines() {
        let text = "Welcome!\nisinglass://wrong\nisinglass-there|Linux x86_64|::1|isinglass 1 (protocol 2)\n* note\n isinglass://h:1/#x \nmore\n";
        let read = |text: &'static str| answer(text.as_bytes(), Duration::from_secs(60), |_| {});
        let Answer { greeting, link, is_late } = read(text);
        assert_eq!(greeting.unwrap().address.as_deref(), Some("::1"));
        assert_eq!((link.as_deref(), is_late), (Some("isinglass://h:1/#x"), false));
        for (text, is_greeted) in
            [("", false), ("isinglass://h:1/#x\n", false), ("isinglass-there|a||missing\nx", true)]
        {
            let Answer { greeting, link, is_late } = read(text);
            assert_eq!((greeting.is_some(), link, is_late), (is_greeted, None, false), "{text}");
        }
        // A machine that talks without end is cut off.
        let endless = std::io::repeat(b'x');
        assert!(answer(endless, Duration::from_secs(60), |_| {}).greeting.is_none());
    }

    #[test]
    fn a_program_that_never_tells_its_version_is_not_waited_for() {
        // Bytes that come, and then nothing: the writing end stays open.
        let quiet = |text: &str| {
            let (read, mut write) = std::io::pipe().unwrap();
            write.write_all(text.as_bytes()).unwrap();
            (read, write)
        };
        let (read, _open) = quiet("Welcome!\nisinglass-begun\n");
        assert!(answer(read, Duration::from_millis(50), |_| {}).is_late);
        // The control: a greeting that is there is read.
        let (read, _open) = quiet("isinglass-begun\nisinglass-there|a||missing\nisinglass://h:1/#x\n");
        let found = answer(read, Duration::from_millis(50), |_| {});
        assert!(!found.is_late && found.greeting.is_some() && found.link.is_some());
    }

    #[test]
    fn only_this_protocol_is_fit() {
        let greeting = |program| Greeting { system: String::new(), address: None, program };
        let version = |number| Program::Version(format!("isinglass 1 (protocol {number})"));
        let own = isinglass_core::wire::PROTOCOL_VERSION;
        assert!(greeting(version(own)).is_fit());
        for other in [version(own + 1), Program::Missing, Program::Broken, Program::Version("x".into())] {
            assert!(!greeting(other).is_fit());
        }
    }
}

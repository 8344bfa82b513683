//! One try to start a server on another machine, and what comes back.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use isinglass_core::text::printable;
use isinglass_net::Link;

use super::Told;
use super::script::{Greeting, Order, Program, SHELL};
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
    let (greeting, link) = answer(stdout, |greeting| {
        if matches!(greeting.program, Program::Version(_)) {
            told.line(&format!("{machine} reads the volume …"));
        }
    });
    if let (Some(greeting), Some(link)) = (&greeting, link) {
        // ssh ends by itself, as the server there lets it go.
        thread::spawn(move || child.wait());
        let link = link.parse().with_context(|| format!("the link of the server on {machine}"))?;
        return Ok(Outcome::Serves(greeting.clone(), link));
    }
    let status = child.wait().context("ssh")?;
    let Heard { complaint, last } = complaints.end();
    match greeting {
        Some(greeting) if status.success() && complaint.is_none() => Ok(Outcome::Unfit(greeting)),
        Some(_) => match complaint {
            Some(complaint) => bail!("{machine}: {complaint}"),
            None => {
                bail!("the server on {machine} has ended before it printed its link{}", shown(last, told))
            }
        },
        None => bail!("{}", unreached(ssh, machine, status, last, told)),
    }
}

/// The greeting and the link in what comes from the other machine; neither if its output ends before.
fn answer(stdout: impl Read, greeted: impl Fn(&Greeting)) -> (Option<Greeting>, Option<String>) {
    let mut lines = BufReader::new(stdout.take(MOST_BYTES)).split(b'\n');
    let (mut greeting, mut link) = (None, None);
    while link.is_none()
        && let Some(Ok(line)) = lines.next()
    {
        let line = String::from_utf8_lossy(&line);
        match &greeting {
            None => greeting = Greeting::of(&line).inspect(&greeted),
            Some(_) => link = Some(line.trim()).filter(|l| l.starts_with("isinglass://")).map(str::to_owned),
        }
    }
    (greeting, link)
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
/// Time for the last lines of an ended process to arrive.
const PATIENCE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_answer_is_found_among_other_lines() {
        let text = "Welcome!\nisinglass://wrong\nisinglass-there|Linux x86_64|::1|isinglass 1 (protocol 2)\n* note\n isinglass://h:1/#x \nmore\n";
        let (greeting, link) = answer(text.as_bytes(), |_| {});
        assert_eq!(greeting.unwrap().address.as_deref(), Some("::1"));
        assert_eq!(link.as_deref(), Some("isinglass://h:1/#x"));
        for (text, is_greeted) in
            [("", false), ("isinglass://h:1/#x\n", false), ("isinglass-there|a||missing\nx", true)]
        {
            let (greeting, link) = answer(text.as_bytes(), |_| {});
            assert_eq!((greeting.is_some(), link), (is_greeted, None), "{text}");
        }
        // A machine that talks without end is cut off.
        let endless = std::io::repeat(b'x');
        assert!(answer(endless, |_| {}).0.is_none());
    }
}

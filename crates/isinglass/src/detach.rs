//! `serve --detach`: a server that goes on when its terminal or its ssh connection closes.

use anyhow::Result;

/// Runs this command again in a session of its own, prints what it prints until it lets go, and returns. If it ends
/// before, this process ends with the same exit code.
///
/// # Errors
/// If the system does not start it.
#[cfg(unix)]
pub(crate) fn run_again() -> Result<()> {
    use std::ffi::OsString;
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};

    use anyhow::Context;

    let mut is_found = false;
    let marked = |argument: OsString| match argument.to_str() {
        Some("--detach") if !std::mem::replace(&mut is_found, true) => "--detached".into(),
        _ => argument,
    };
    let arguments = std::env::args_os().skip(1).map(marked);
    let own = std::env::current_exe().context("this program")?;
    let mut command = Command::new(own);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = command.spawn().context("cannot start the server")?;
    let mut has_links = false;
    if let Some(stdout) = child.stdout.take() {
        for line in BufReader::new(stdout).lines() {
            crate::report::print(&(line? + "\n"))?;
            has_links = true;
        }
    }
    if !has_links {
        // It has told why.
        let status = child.wait().context("the server")?;
        std::process::exit(status.code().unwrap_or(1));
    }
    Ok(())
}

#[cfg(not(unix))]
pub(crate) fn run_again() -> Result<()> {
    anyhow::bail!("--detach is not there on this system")
}

/// Leaves the session of the terminal.
///
/// # Errors
/// If the system refuses.
pub(crate) fn leave_terminal() -> Result<()> {
    #[cfg(unix)]
    rustix::process::setsid()?;
    Ok(())
}

/// Closes the streams that others wait for. From now on nobody reads what this process writes.
///
/// # Errors
/// If the system refuses.
pub(crate) fn let_go() -> Result<()> {
    #[cfg(unix)]
    {
        let nothing = std::fs::File::options().read(true).write(true).open("/dev/null")?;
        rustix::stdio::dup2_stdin(&nothing)?;
        rustix::stdio::dup2_stdout(&nothing)?;
        rustix::stdio::dup2_stderr(&nothing)?;
    }
    Ok(())
}

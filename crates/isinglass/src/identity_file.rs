//! A file that keeps a server's certificate and key between runs.

use std::io::{ErrorKind, Read};
use std::path::Path;

use anyhow::{Context, Result, bail};
use isinglass_formats::{FormatError, open_file, write_new_private};
use isinglass_net::Identity;

/// Reads the identity in a file. Without the file, a new identity is made and kept there, readable for its owner alone.
///
/// # Errors
/// If the file holds no identity, others can read it, or it cannot be read or made.
pub(crate) fn read_or_make(path: &Path) -> Result<Identity> {
    let shown = path.display();
    let mut file = match open_file(path) {
        Ok(file) => file,
        Err(FormatError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => return make(path),
        Err(e) => return Err(e).context("cannot read an identity"),
    };
    #[cfg(unix)]
    {
        let mode = std::os::unix::fs::PermissionsExt::mode(&file.metadata()?.permissions()) & 0o777;
        if mode & 0o077 != 0 {
            bail!(
                "{shown} has the mode {mode:04o}, so others can use its key; keep it to yourself: chmod 600 {shown}"
            );
        }
    }
    let mut text = String::new();
    (&mut file).take(MOST_BYTES).read_to_string(&mut text).with_context(|| format!("cannot read {shown}"))?;
    if text.trim().is_empty() {
        bail!(
            "{shown} is empty and holds no certificate; remove it, and the next start makes a new identity"
        );
    }
    Identity::from_pem(&text).with_context(|| format!("{shown} is no identity of a server"))
}

fn make(path: &Path) -> Result<Identity> {
    let identity = Identity::generate()?;
    let kept = write_new_private(path, identity.to_pem().as_bytes());
    kept.with_context(|| format!("cannot keep an identity in {}", path.display()))?;
    Ok(identity)
}

/// Longest file. An identity has about 1 kB.
const MOST_BYTES: u64 = 64 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_is_made_once_and_for_its_owner() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("identity.pem");
        let made = read_or_make(&path).unwrap().fingerprint();
        assert_eq!(read_or_make(&path).unwrap().fingerprint(), made);
        #[cfg(unix)]
        assert_eq!(
            std::os::unix::fs::PermissionsExt::mode(&path.metadata().unwrap().permissions()) & 0o777,
            0o600
        );
        for text in ["nothing", "", " \n"] {
            std::fs::write(&path, text).unwrap();
            let problem = format!("{:#}", read_or_make(&path).unwrap_err());
            assert!(problem.contains("identity.pem") && problem.contains("certificate"), "{problem}");
        }
        assert!(read_or_make(&folder.path().join("no/such")).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_key_that_others_can_read_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("identity.pem");
        let made = read_or_make(&path).unwrap().fingerprint();
        for (mode, is_good) in
            [(0o644, false), (0o640, false), (0o604, false), (0o660, false), (0o600, true), (0o400, true)]
        {
            std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).unwrap();
            match read_or_make(&path) {
                Ok(identity) => assert!(is_good && identity.fingerprint() == made, "{mode:o}"),
                Err(e) => {
                    let line = format!("{e:#}");
                    assert!(!is_good && line.contains(&format!("chmod 600 {}", path.display())), "{line}");
                    assert!(line.contains(&format!("{mode:04o}")) && !line.contains('\n'), "{line}");
                }
            }
        }
        // What is no file is named, and not waited for.
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        assert!(format!("{:#}", read_or_make(&pipe).unwrap_err()).contains("a pipe"));
    }
}

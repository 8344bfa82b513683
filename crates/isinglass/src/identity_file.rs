//! A file that keeps a server's certificate and key between runs.

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::{Context, Result};
use isinglass_net::Identity;

/// Reads the identity in a file. Without the file, a new identity is made and kept there, readable for its owner
/// alone.
///
/// # Errors
/// If the file holds no identity, or cannot be read or made.
pub(crate) fn read_or_make(path: &Path) -> Result<Identity> {
    let shown = path.display();
    match std::fs::read_to_string(path) {
        Ok(text) => Identity::from_pem(&text).with_context(|| format!("{shown} is no identity of a server")),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            let identity = Identity::generate()?;
            write_new(path, &identity.to_pem())
                .with_context(|| format!("cannot keep an identity in {shown}"))?;
            Ok(identity)
        }
        Err(e) => Err(e).with_context(|| format!("cannot read {shown}")),
    }
}

fn write_new(path: &Path, text: &str) -> std::io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)?.write_all(text.as_bytes())
}

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
        std::fs::write(&path, "nothing").unwrap();
        let problem = format!("{:#}", read_or_make(&path).unwrap_err());
        assert!(problem.contains("identity.pem") && problem.contains("certificate"), "{problem}");
        assert!(read_or_make(&folder.path().join("no/such")).is_err());
    }
}

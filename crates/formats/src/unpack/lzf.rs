//! LZF (liblzf): runs of literal bytes, and copies of what came before.

/// Decodes `packed` and appends at most `most` bytes to `out`, which is empty.
pub(super) fn decode(packed: &[u8], most: usize, out: &mut Vec<u8>) -> Result<(), String> {
    let mut rest = packed;
    let mut take = |n: usize| -> Result<&[u8], String> {
        let (taken, after) = rest.split_at_checked(n).ok_or("LZF data end early")?;
        rest = after;
        Ok(taken)
    };
    while let Ok(&[control]) = take(1) {
        let control = usize::from(control);
        if control < MAX_LITERALS {
            out.extend_from_slice(take(control + 1)?);
        } else {
            let mut length = control >> 5;
            if length == 7 {
                length += usize::from(take(1)?[0]);
            }
            let back = (control & 0x1f) << 8 | usize::from(take(1)?[0]);
            let from = out.len().checked_sub(back + 1).ok_or("LZF data refer to what is before them")?;
            // The copy may reach into itself.
            (from..from + length + 2).for_each(|i| out.push(out[i]));
        }
        if out.len() > most {
            return Err(format!("LZF data have more than {most} bytes"));
        }
    }
    Ok(())
}

/// A smaller control byte is before literals.
const MAX_LITERALS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals_and_copies_are_joined_and_faults_found() {
        let decoded = |packed: &[u8], most| {
            let mut out = Vec::new();
            decode(packed, most, &mut out).map(|()| out)
        };
        // Three literals, a copy of five from three before, and a long one of the last byte.
        let packed = [2, b'a', b'b', b'c', 3 << 5, 2, 7 << 5, 1, 0];
        let expected = [&b"abcabcab"[..], &[b'b'; 10]].concat();
        assert_eq!(decoded(&packed, 18), Ok(expected));
        assert!(decoded(&packed, 17).unwrap_err().contains("more than 17"));
        assert!(decoded(&packed[..5], 99).unwrap_err().contains("early"));
        assert!(decoded(&[0, b'a', 1 << 5, 1], 99).unwrap_err().contains("before"));
        assert_eq!(decoded(&[], 0), Ok(vec![]));
    }
}

//! Lists of data files that one header names.

/// Replaces the one `%d`, `%3d`, `%03d` or `%u` in `pattern` by each number from `first` to `last`. Returns `None`
/// for an invalid pattern, or if the list is too long.
pub(crate) fn numbered_names(pattern: &str, first: i64, last: i64, step: i64) -> Option<Vec<String>> {
    if step == 0 {
        return None;
    }
    let mut names = Vec::new();
    let mut i = first;
    while (step > 0 && i <= last) || (step < 0 && i >= last) {
        if names.len() == MAX_DATA_FILES {
            return None;
        }
        names.push(numbered(pattern, i)?);
        i = i.checked_add(step)?;
    }
    Some(names)
}

/// Replaces the one `%d`, `%3d`, `%03d` or `%u` in `pattern` by `number`.
fn numbered(pattern: &str, number: i64) -> Option<String> {
    let (before, rest) = pattern.split_once('%')?;
    let end = rest.find(|c: char| !c.is_ascii_digit())?;
    let (width, after) = (&rest[..end], rest[end..].strip_prefix(['d', 'u', 'i'])?);
    if after.contains('%') || width.len() > 3 {
        return None;
    }
    let (is_zero_padded, columns) = (width.starts_with('0'), width.parse().unwrap_or(0));
    let digits = if is_zero_padded { format!("{number:0columns$}") } else { format!("{number:columns$}") };
    Some(format!("{before}{digits}{after}"))
}

/// Most files of one header.
pub(crate) const MAX_DATA_FILES: usize = 65_536;

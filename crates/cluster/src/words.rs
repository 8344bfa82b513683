//! Bytes in words: their number, and then four a word.

/// Adds bytes to words.
pub(crate) fn push_bytes(words: &mut Vec<u32>, bytes: &[u8]) {
    words.push(bytes.len() as u32);
    words.extend(bytes.chunks(4).map(|four| {
        let mut word = [0; 4];
        word[..four.len()].copy_from_slice(four);
        u32::from_le_bytes(word)
    }));
}

/// Takes what [`push_bytes`] added from the front of words; `None` if there are too few.
pub(crate) fn take_bytes(words: &mut &[u32]) -> Option<Vec<u8>> {
    let (num, rest) = words.split_first()?;
    let (own, rest) = rest.split_at_checked(num.div_ceil(4) as usize)?;
    *words = rest;
    let mut bytes: Vec<u8> = own.iter().flat_map(|word| word.to_le_bytes()).collect();
    bytes.truncate(*num as usize);
    Some(bytes)
}

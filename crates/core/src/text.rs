//! Texts of a peer or a file, before they reach a terminal or a window.

/// Whether a character changes how the text around it is shown, and shows nothing itself: a control character, an end
/// of a line, or one that sets the direction of writing. The last kind could make `exe.nii` of `iin.exe`.
pub fn is_control(c: char) -> bool {
    let sets_direction = matches!(
        c,
        '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}'
    );
    c.is_control() || sets_direction || matches!(c, '\u{2028}' | '\u{2029}')
}

/// The text with a blank in place of each control character, and at most `max_chars` characters.
pub fn one_line(text: &str, max_chars: usize) -> String {
    text.chars().map(|c| if is_control(c) { ' ' } else { c }).take(max_chars).collect()
}

/// The text without control characters, and at most `max_chars` characters.
pub fn printable(text: &str, max_chars: usize) -> String {
    text.chars().filter(|c| !is_control(*c)).take(max_chars).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_rewrites_its_surroundings_is_found_and_writing_is_not() {
        let (mut all, mut bad) = (0, 0);
        for range in [0..=0x1f, 0x7f..=0x9f, 0x61c..=0x61c, 0x200e..=0x200f, 0x2028..=0x202e, 0x2066..=0x2069]
        {
            for c in range.filter_map(char::from_u32) {
                all += 1;
                bad += u32::from(is_control(c));
            }
        }
        assert_eq!((all, bad), (79, 79));
        // The control: scripts that run from right to left, joiners in emoji, and blanks.
        for c in " aµ頭راس‍🧠\u{a0}\u{200d}".chars() {
            assert!(!is_control(c), "{c:?}");
        }
        assert_eq!(one_line("a\nb\u{202e}c", 10), "a b c");
        assert_eq!((printable("a\nb\u{202e}c", 10), one_line("µµµ", 2)), ("abc".into(), "µµ".into()));
    }
}

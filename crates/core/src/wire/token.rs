//! The 128-bit secrets that let a viewer in.

use serde::{Deserialize, Serialize};

/// A secret of 128 random bits. Its text is 32 lower-case hexadecimal digits; `Debug` does not show it.
#[derive(Clone, Serialize, Deserialize)]
pub struct Token([u8; 16]);

/// Why a text is not a token.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
#[error("expected 32 hexadecimal digits, found {0} bytes")]
pub struct TokenError(usize);

impl Token {
    /// A token from 16 bytes, which must come from the operating system's generator.
    pub fn new(bytes: [u8; 16]) -> Self {
        Self(bytes)
    }

    /// Whether both are equal, in constant time.
    pub fn matches(&self, other: &Self) -> bool {
        let difference = self.0.iter().zip(&other.0).fold(0u8, |d, (a, b)| d | (a ^ b));
        // Keeps the compiler from returning early.
        std::hint::black_box(difference) == 0
    }

    /// The secret as text, for a link.
    pub fn reveal(&self) -> String {
        self.0.iter().map(|b| format!("{b:02x}")).collect()
    }
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(…)")
    }
}

impl std::str::FromStr for Token {
    type Err = TokenError;

    fn from_str(s: &str) -> Result<Self, TokenError> {
        let mut bytes = [0; 16];
        if s.len() != 32 || !s.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(TokenError(s.len()));
        }
        for (byte, digits) in bytes.iter_mut().zip(s.as_bytes().chunks_exact(2)) {
            let digit = |d: u8| (d as char).to_digit(16).unwrap_or(0) as u8;
            *byte = digit(digits[0]) << 4 | digit(digits[1]);
        }
        Ok(Self(bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_the_inverse_of_parsing_and_debug_hides_it() {
        let token = Token::new(std::array::from_fn(|i| (i * 17) as u8));
        let text = token.reveal();
        assert!(token.matches(&text.parse().unwrap()));
        assert!(token.matches(&text.to_uppercase().parse().unwrap()));
        assert!(!format!("{token:?}").contains(&text[..4]));
        for bad in ["", "12", &text[1..], &format!("{text}0"), &text.replace('0', "g"), "éééééééééééééééé"]
        {
            assert!(bad.parse::<Token>().is_err(), "{bad}");
        }
    }

    #[test]
    fn every_byte_counts_in_a_comparison() {
        let token = Token::new([7; 16]);
        for i in 0..16 {
            let mut other = [7; 16];
            other[i] ^= 1;
            assert!(!token.matches(&Token::new(other)));
        }
    }
}

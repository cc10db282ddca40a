//! The secret that clients of a server know.

use crate::{Error, Result};
use http::HeaderMap;
use http::header::AUTHORIZATION;
use std::fmt;
use std::path::Path;
use subtle::ConstantTimeEq as _;

/// A bearer token. Its text is in no message.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// A token of this text, without the space round it.
    ///
    /// # Errors
    /// When nothing is left, or it has characters that no header may have.
    pub fn new(text: &str) -> Result<Self> {
        let text = text.trim();
        if text.is_empty() || !text.bytes().all(|b| b.is_ascii_graphic()) {
            let found = if text.is_empty() { "nothing" } else { "other characters" };
            let expected = "one word of printable ASCII";
            return Err(Error::Setting { setting: "token", expected, found: found.to_owned() });
        }
        Ok(Self(text.to_owned()))
    }

    /// The token in a file.
    ///
    /// # Errors
    /// When the file cannot be read, or has no token.
    pub fn read(file: &Path) -> Result<Self> {
        let doing = || format!("reading the token {}", file.display());
        Self::new(&std::fs::read_to_string(file).map_err(|source| Error::Io { doing: doing(), source })?)
    }

    /// Whether a request knows it: `Authorization: Bearer TOKEN`, or `Api-Key TOKEN` as openpi's client writes it.
    pub(crate) fn is_in(&self, headers: &HeaderMap) -> bool {
        let Some(value) = headers.get(AUTHORIZATION).and_then(|v| v.to_str().ok()) else { return false };
        let Some((scheme, found)) = value.split_once(' ') else { return false };
        let known = ["bearer", "api-key"].iter().any(|s| scheme.eq_ignore_ascii_case(s));
        // In constant time: how long a refusal takes says nothing of how much was right.
        known && bool::from(self.0.as_bytes().ct_eq(found.trim().as_bytes()))
    }

    /// The header that says it.
    pub(crate) fn header(&self) -> String {
        format!("Api-Key {}", self.0)
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

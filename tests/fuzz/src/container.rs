//! Several files in one input, and checksums made to fit.

use sha2::{Digest, Sha256};

/// Cuts an input in two where its first two bytes say.
pub fn split(input: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = input.split_first_chunk::<2>()?;
    rest.split_at_checked(usize::from(u16::from_le_bytes(*length)))
}

/// The input that [`split`] cuts into these.
pub fn join(first: &[u8], second: &[u8]) -> Vec<u8> {
    let length = u16::try_from(first.len()).expect("below 64 KiB").to_le_bytes();
    [&length, first, second].concat()
}

/// A checkpoint's description with the checksum of these weights: without it nothing behind the checksum would ever run.
pub fn with_checksum(json: &[u8], weights: &[u8]) -> Vec<u8> {
    let Ok(mut value) = serde_json::from_slice::<serde_json::Value>(json) else { return json.to_vec() };
    if let Some(sum) = value.get_mut("weights_sha256").filter(|v| v.is_string()) {
        let hex: String = Sha256::digest(weights).iter().map(|b| format!("{b:02x}")).collect();
        *sum = hex.into();
    }
    value.to_string().into_bytes()
}

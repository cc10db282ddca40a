use rand::SeedableRng;

/// The generator of every random number in the project: portable, seekable, cheap to fork.
pub type Rng = rand_chacha::ChaCha8Rng;

/// An independent stream for one purpose. Seeds come from what the numbers are for, never from a thread or worker, so
/// results do not depend on how many of those ran.
///
/// # Source
/// The four values are the key of the ChaCha cipher itself. Seed, iteration and index enter as they are and never make two
/// streams meet; `purpose` enters as its 64-bit FNV-1a hash, so two purposes meet only where their hashes do.
#[must_use]
pub fn stream(seed: u64, purpose: &str, iteration: u64, index: u64) -> Rng {
    let mut key = [0; 32];
    for (chunk, value) in key.chunks_exact_mut(8).zip([seed, fnv1a(purpose.bytes()), iteration, index]) {
        chunk.copy_from_slice(&value.to_le_bytes());
    }
    Rng::from_seed(key)
}

/// The 64-bit FNV-1a hash: the same on every machine and in every version.
///
/// ```
/// assert_eq!(e2h_core::fnv1a(*b"foobar"), 0x8594_4171_f739_67e8);
/// ```
#[must_use]
pub fn fnv1a(bytes: impl IntoIterator<Item = u8>) -> u64 {
    let mix = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    bytes.into_iter().fold(0xcbf2_9ce4_8422_2325, mix)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngCore;

    #[test]
    fn streams_repeat_and_differ() {
        let a = stream(1, "noise", 0, 0).next_u64();
        assert_eq!(a, stream(1, "noise", 0, 0).next_u64());
        for other in [
            stream(2, "noise", 0, 0),
            stream(1, "crop", 0, 0),
            stream(1, "noise", 1, 0),
            stream(1, "noise", 0, 1),
        ] {
            assert_ne!(a, other.clone().next_u64());
        }
    }
}

//! Values into bytes.

use super::{Array, Value};
use rmp::encode::buffer::ByteBuf;
use rmp::encode::{
    ValueWriteError, write_array_len, write_bin, write_bool, write_f64, write_map_len, write_nil, write_sint,
    write_str, write_uint,
};
use std::convert::Infallible;

/// Writing into memory does not fail.
type Done = Result<(), ValueWriteError<Infallible>>;

/// Lengths of 2^32 and more are none that a message has: memory ends before.
fn length(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

impl Value {
    /// The bytes of a message.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = ByteBuf::new();
        match self.write(&mut out) {
            Ok(()) => {}
            Err(ValueWriteError::InvalidMarkerWrite(e) | ValueWriteError::InvalidDataWrite(e)) => match e {},
        }
        out.into_vec()
    }

    fn write(&self, out: &mut ByteBuf) -> Done {
        match self {
            Self::Nil => write_nil(out).map_err(ValueWriteError::InvalidMarkerWrite),
            Self::Bool(v) => write_bool(out, *v).map_err(ValueWriteError::InvalidMarkerWrite),
            Self::Int(v) => write_sint(out, *v).map(|_| ()),
            Self::Large(v) => write_uint(out, *v).map(|_| ()),
            Self::Float(v) => write_f64(out, *v),
            Self::Text(v) => write_str(out, v),
            Self::Bytes(v) => write_bin(out, v),
            Self::List(v) => {
                write_array_len(out, length(v.len()))?;
                v.iter().try_for_each(|v| v.write(out))
            }
            Self::Map(v) => {
                write_map_len(out, length(v.len()))?;
                v.iter().try_for_each(|(key, v)| {
                    write_str(out, key)?;
                    v.write(out)
                })
            }
            Self::Array(a) => array(a, out),
        }
    }
}

fn array(a: &Array, out: &mut ByteBuf) -> Done {
    write_map_len(out, 4)?;
    write_bin(out, b"__ndarray__")?;
    write_bool(out, true).map_err(ValueWriteError::InvalidMarkerWrite)?;
    write_bin(out, b"data")?;
    write_bin(out, a.data())?;
    write_bin(out, b"dtype")?;
    write_str(out, a.dtype().name())?;
    write_bin(out, b"shape")?;
    write_array_len(out, length(a.shape().len()))?;
    a.shape().iter().try_for_each(|side| write_uint(out, *side as u64).map(|_| ()))
}

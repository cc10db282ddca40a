//! Bytes into values.

use super::{Array, Dtype, MOST_DEPTH, MOST_VALUES, Value};
use crate::{Error, Result};
use rmp::Marker;
use rmp::decode::{
    NumValueReadError, ValueReadError, read_array_len, read_bin_len, read_bool, read_f32, read_f64, read_int,
    read_map_len, read_nil, read_str_len,
};

impl Value {
    /// Reads a whole message.
    ///
    /// # Errors
    /// When it is no msgpack, ends early or late, is nested deeper than [`MOST_DEPTH`], has more than [`MOST_VALUES`] values, or an
    /// array in it is none.
    pub fn decode(message: &[u8]) -> Result<Self> {
        let mut reader = Reader { rest: message, values: 0 };
        let value = reader.value(0)?;
        match reader.rest.len() {
            0 => Ok(value),
            n => Err(broken("its end", &format!("{n} more bytes"))),
        }
    }
}

struct Reader<'a> {
    rest: &'a [u8],
    values: usize,
}

fn broken(expected: &str, found: &str) -> Error {
    Error::mismatch("message", expected, found)
}

fn early<T>(_: T) -> Error {
    broken("a whole msgpack value", "its end in the middle of one")
}

impl<'a> Reader<'a> {
    fn take(&mut self, n: u32) -> Result<&'a [u8]> {
        let n = usize::try_from(n).map_err(early)?;
        let (taken, rest) = self.rest.split_at_checked(n).ok_or_else(|| early(()))?;
        self.rest = rest;
        Ok(taken)
    }

    fn marker(&self) -> Result<Marker> {
        self.rest.first().map(|b| Marker::from_u8(*b)).ok_or_else(|| early(()))
    }

    fn value(&mut self, depth: usize) -> Result<Value> {
        self.values += 1;
        if self.values > MOST_VALUES {
            return Err(broken(&format!("at most {MOST_VALUES} values"), "more"));
        }
        if depth > MOST_DEPTH {
            return Err(broken(&format!("at most {MOST_DEPTH} levels"), "more"));
        }
        let marker = self.marker()?;
        let rest = &mut self.rest;
        match marker {
            Marker::Null => read_nil(rest).map(|()| Value::Nil).map_err(early),
            Marker::True | Marker::False => read_bool(rest).map(Value::Bool).map_err(early),
            Marker::FixPos(_) | Marker::FixNeg(_) | Marker::U8 | Marker::U16 | Marker::U32 => self.int(),
            Marker::U64 | Marker::I8 | Marker::I16 | Marker::I32 | Marker::I64 => self.int(),
            Marker::F32 => read_f32(rest).map(|v| Value::Float(f64::from(v))).map_err(early),
            Marker::F64 => read_f64(rest).map(Value::Float).map_err(early),
            Marker::FixStr(_) | Marker::Str8 | Marker::Str16 | Marker::Str32 => {
                self.text().map(|t| Value::Text(t.to_owned()))
            }
            Marker::Bin8 | Marker::Bin16 | Marker::Bin32 => self.bytes().map(|b| Value::Bytes(b.to_owned())),
            Marker::FixArray(_) | Marker::Array16 | Marker::Array32 => {
                let n = read_array_len(rest).map_err(early)?;
                // Nothing is reserved for what only the length promises.
                let mut list = vec![];
                for _ in 0..n {
                    list.push(self.value(depth + 1)?);
                }
                Ok(Value::List(list))
            }
            Marker::FixMap(_) | Marker::Map16 | Marker::Map32 => {
                let n = read_map_len(rest).map_err(early)?;
                let bin = |m| matches!(m, Marker::Bin8 | Marker::Bin16 | Marker::Bin32);
                if n > 0 && bin(self.marker()?) {
                    return self.numpy(n);
                }
                let mut map = std::collections::BTreeMap::new();
                for _ in 0..n {
                    let key = self.text()?.to_owned();
                    map.insert(key, self.value(depth + 1)?);
                }
                Ok(Value::Map(map))
            }
            other => Err(broken("numbers, text, bytes, lists and maps", &format!("{other:?}"))),
        }
    }

    fn int(&mut self) -> Result<Value> {
        let start = self.rest;
        match read_int::<i64, _>(&mut self.rest) {
            Ok(v) => Ok(Value::Int(v)),
            Err(NumValueReadError::OutOfRange) => {
                self.rest = start;
                read_int::<u64, _>(&mut self.rest).map(Value::Large).map_err(early)
            }
            Err(e) => Err(early(e)),
        }
    }

    fn text(&mut self) -> Result<&'a str> {
        let n = read_str_len(&mut self.rest).map_err(|e| match e {
            ValueReadError::TypeMismatch(m) => broken("a key of text", &format!("{m:?}")),
            e => early(e),
        })?;
        let bytes = self.take(n)?;
        std::str::from_utf8(bytes).map_err(|_| broken("text in UTF-8", "other bytes"))
    }

    fn bytes(&mut self) -> Result<&'a [u8]> {
        let n = read_bin_len(&mut self.rest).map_err(|e| match e {
            ValueReadError::TypeMismatch(m) => broken("bytes", &format!("{m:?}")),
            e => early(e),
        })?;
        self.take(n)
    }

    /// A map whose keys are bytes: an array or a scalar of numpy's.
    fn numpy(&mut self, n: u32) -> Result<Value> {
        let (mut array, mut scalar) = (false, false);
        let (mut bytes, mut value, mut dtype, mut shape) = (None, None, None, None);
        if n > 4 {
            return Err(broken("an array of numpy's with 4 keys", &format!("{n} keys of bytes")));
        }
        for _ in 0..n {
            match self.bytes()? {
                b"__ndarray__" => array = self.truth()?,
                b"__npgeneric__" => scalar = self.truth()?,
                b"dtype" => dtype = Some(self.text()?),
                b"shape" => shape = Some(self.shape()?),
                b"data" if matches!(self.marker()?, Marker::Bin8 | Marker::Bin16 | Marker::Bin32) => {
                    bytes = Some(self.bytes()?);
                }
                b"data" => value = Some(self.value(MOST_DEPTH)?),
                other => {
                    let found = String::from_utf8_lossy(other).into_owned();
                    return Err(broken("the keys of an array of numpy's", &format!("`{found}`")));
                }
            }
        }
        match (array, scalar, dtype, shape, bytes, value) {
            (true, false, Some(dtype), Some(shape), Some(data), None) => {
                Ok(Value::Array(Array::new(Dtype::of(dtype)?, shape, data.to_owned())?))
            }
            // A scalar says its number as Python does; whose width it had there changes nothing here.
            (false, true, Some(dtype), None, None, Some(value)) => match (dtype.as_bytes(), value) {
                ([_, b'b' | b'i' | b'u' | b'f', ..], v @ (Value::Bool(_) | Value::Int(_)))
                | ([_, b'u' | b'f', ..], v @ (Value::Large(_) | Value::Float(_)))
                | ([_, b'U', ..], v @ Value::Text(_)) => Ok(v),
                (_, v) => {
                    let found = format!("{} as `{dtype}`", v.kind());
                    Err(broken("a scalar of numpy's that is a number or text", &found))
                }
            },
            _ => Err(broken("an array or a scalar of numpy's", "a map of bytes with other keys")),
        }
    }

    fn truth(&mut self) -> Result<bool> {
        read_bool(&mut self.rest).map_err(|_| broken("true in the mark of an array", "something else"))
    }

    fn shape(&mut self) -> Result<Vec<usize>> {
        let wrong = || broken("a shape of whole numbers", "something else");
        let n = read_array_len(&mut self.rest).map_err(|_| wrong())?;
        if n > 32 {
            return Err(broken("a shape of at most 32 sides", &n.to_string()));
        }
        (0..n)
            .map(|_| {
                read_int::<u64, _>(&mut self.rest).ok().and_then(|v| v.try_into().ok()).ok_or_else(wrong)
            })
            .collect()
    }
}

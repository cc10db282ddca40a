//! Messages: there and back, and bytes that are none.

use e2h_serve::wire::{Array, Dtype, MOST_DEPTH, MOST_VALUES, Value};
use proptest::prelude::*;

fn array() -> impl Strategy<Value = Value> {
    (0..Dtype::ALL.len(), prop::collection::vec(0_usize..5, 0..4), any::<u64>()).prop_map(
        |(d, shape, seed)| {
            let dtype = Dtype::ALL[d];
            let n = shape.iter().product::<usize>() * dtype.size();
            let byte = |i: usize| {
                let byte = (seed.wrapping_mul(i as u64 * 2 + 1) >> 32) as u8;
                if dtype == Dtype::B1 { byte & 1 } else { byte }
            };
            Array::new(dtype, shape, (0..n).map(byte).collect()).unwrap().into()
        },
    )
}

fn value() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Nil),
        any::<bool>().prop_map(Value::Bool),
        any::<i64>().prop_map(Value::Int),
        any::<u64>().prop_map(Value::from),
        any::<f64>().prop_filter("NaN is not equal to itself", |v| !v.is_nan()).prop_map(Value::Float),
        ".{0,40}".prop_map(Value::Text),
        prop::collection::vec(any::<u8>(), 0..300).prop_map(Value::Bytes),
        array(),
    ];
    leaf.prop_recursive(4, 64, 8, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..20).prop_map(Value::List),
            prop::collection::btree_map(".{0,12}", inner, 0..20).prop_map(Value::Map),
        ]
    })
}

proptest! {
    #[test]
    fn what_is_written_is_read(v in value()) {
        prop_assert_eq!(Value::decode(&v.encode()).unwrap(), v);
    }

    #[test]
    fn no_bytes_make_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = Value::decode(&bytes);
    }

    #[test]
    fn a_message_with_a_wrong_byte_is_read_or_refused(v in value(), at in any::<prop::sample::Index>(), byte: u8) {
        let mut bytes = v.encode();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        let _ = Value::decode(&bytes);
    }

    #[test]
    fn a_part_of_a_message_is_refused(v in value(), at in any::<prop::sample::Index>()) {
        let bytes = v.encode();
        prop_assert!(Value::decode(&bytes[..at.index(bytes.len())]).is_err());
    }
}

fn refused(bytes: &[u8], words: &str) {
    let error = Value::decode(bytes).unwrap_err().to_string();
    assert!(error.contains(words), "expected `{words}` in: {error}");
}

/// An array as openpi packs it, of whatever is said.
fn packed(dtype: &str, shape: &[u64], data: &[u8]) -> Vec<u8> {
    let mut out = vec![0x84, 0xc4, 11];
    out.extend(b"__ndarray__");
    out.extend([0xc3, 0xc4, 4]);
    out.extend(b"data");
    out.extend([0xc4, u8::try_from(data.len()).unwrap()]);
    out.extend(data);
    out.extend([0xc4, 5]);
    out.extend(b"dtype");
    out.push(0xa0 | u8::try_from(dtype.len()).unwrap());
    out.extend(dtype.bytes());
    out.extend([0xc4, 5]);
    out.extend(b"shape");
    out.push(0x90 | u8::try_from(shape.len()).unwrap());
    for side in shape {
        out.push(0xcf);
        out.extend(side.to_be_bytes());
    }
    out
}

#[test]
fn an_array_is_packed_as_openpi_does() {
    let array = Array::f32(&[2], &[1.0, -2.0]);
    let bytes = Value::from(array.clone()).encode();
    // As `msgpack_numpy.packb(np.array([1, -2], np.float32))` of openpi-client 0.1.2 writes it.
    let expected = b"\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x08\x00\x00\x80?\x00\x00\x00\xc0\xc4\x05dtype\xa3<f4\xc4\x05shape\x91\x02";
    assert_eq!(bytes, expected);
    assert_eq!(Value::decode(&packed("<f4", &[2], array.data())).unwrap(), Value::Array(array));
}

#[test]
fn numpy_scalars_are_numbers() {
    let scalar = |dtype: &str, data: &[u8]| {
        let mut out = b"\x83\xc4\x0d__npgeneric__\xc3\xc4\x04data".to_vec();
        out.extend(data);
        out.extend(b"\xc4\x05dtype");
        out.push(0xa0 | u8::try_from(dtype.len()).unwrap());
        out.extend(dtype.bytes());
        out
    };
    assert_eq!(Value::decode(&scalar("<i8", &[7])).unwrap(), Value::Int(7));
    assert_eq!(Value::decode(&scalar("|b1", &[0xc2])).unwrap(), Value::Bool(false));
    let half = [&[0xcb_u8][..], &0.5_f64.to_be_bytes()].concat();
    assert_eq!(Value::decode(&scalar("<f4", &half)).unwrap(), Value::Float(0.5));
    refused(&scalar("|O", &[7]), "`|O`");
    refused(&scalar("<c8", &[7]), "`<c8`");
}

#[test]
fn arrays_that_are_none_are_refused_by_name() {
    let wanted = "as many as [3] of <f4 has, found 8";
    refused(&packed("<f4", &[3], &[0; 8]), wanted);
    refused(&packed(">f4", &[2], &[0; 8]), "`>f4`");
    refused(&packed("|O", &[1], &[0; 8]), "`|O`");
    refused(&packed("|b1", &[2], &[0, 2]), "bytes of 0 or 1");
    // 2^62 times 4 is 0 in 64 bits.
    refused(&packed("<f4", &[1 << 62], &[]), "bytes of an array");
    refused(&packed("<f4", &[1 << 32, 1 << 32], &[]), "bytes of an array");
    refused(&packed("<f4", &[1; 9], &[0; 4]), "dimensions of an array: expected at most 8, found 9");
}

#[test]
fn small_messages_that_promise_much_are_refused() {
    // 4 Gi of entries, text, bytes.
    for marker in [0xdd, 0xdf, 0xdb, 0xc6] {
        refused(&[marker, 0xff, 0xff, 0xff, 0xff, 0xc0], "message");
    }
    let deep = [vec![0x91; MOST_DEPTH + 2], vec![0xc0]].concat();
    refused(&deep, "16 levels");
    // A list of more values than a message may have, a byte each.
    let n = u32::try_from(MOST_VALUES).unwrap();
    let many = [&[0xdd][..], &n.to_be_bytes(), &vec![0xc0; MOST_VALUES]].concat();
    refused(&many, "65536 values");
    refused(&[0x81, 0x01, 0xc0], "a key of text");
    refused(&[0xc0, 0xc0], "1 more bytes");
    refused(&[], "in the middle");
    refused(&[0xc7, 1, 5, 0], "Ext8");
}

//! Images of a dataset. Checksums are passed over while fuzzing, and half of the inputs are packed by the target, so that
//! bytes reach the pixels.

#![no_main]

use e2h_data::lerobot::{decode_png, encode_png};
use e2h_fuzz::{begin, judge, run};
use libfuzzer_sys::fuzz_target;
use std::path::Path;

/// A file: its size, and its bytes as they are.
fn plain(height: u8, width: u8, bytes: &[u8]) -> Vec<u8> {
    [&[0, height, width], bytes].concat()
}

fn chunk(out: &mut Vec<u8>, name: &[u8; 4], bytes: &[u8]) {
    out.extend((bytes.len() as u32).to_be_bytes());
    out.extend(name);
    out.extend(bytes);
    // Looked at by nobody while fuzzing.
    out.extend([0; 4]);
}

/// A file around filtered lines: stored, not compressed. `kind` has depth, colour and interlacing.
fn packed(height: u8, width: u8, kind: [u8; 3], palette: &[u8], lines: &[u8]) -> Vec<u8> {
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    let header = [0, 0, 0, width, 0, 0, 0, height, kind[0], kind[1], 0, 0, kind[2]];
    chunk(&mut out, b"IHDR", &header);
    if kind[1] == 3 {
        chunk(&mut out, b"PLTE", &palette[..palette.len() / 3 * 3]);
    }
    if kind[1] < 4 {
        chunk(&mut out, b"tRNS", palette);
    }
    let mut zlib = vec![0x78, 0x01];
    let mut parts = lines.chunks(0xffff).peekable();
    while let Some(part) = parts.next() {
        zlib.push(u8::from(parts.peek().is_none()));
        zlib.extend((part.len() as u16).to_le_bytes());
        zlib.extend((!(part.len() as u16)).to_le_bytes());
        zlib.extend(part);
    }
    zlib.extend([0; 4]);
    chunk(&mut out, b"IDAT", &zlib);
    chunk(&mut out, b"IEND", &[]);
    out
}

fn seeds() -> Vec<Vec<u8>> {
    let pixels: Vec<u8> = (0..7 * 5 * 3).map(|i| (i * 31) as u8).collect();
    let mut seeds = vec![plain(7, 5, &encode_png(7, 5, &pixels).expect("an image"))];
    for (colour, depth) in [(0, 1), (0, 8), (0, 16), (2, 8), (2, 16), (3, 2), (3, 8), (4, 8), (6, 8), (6, 16)]
    {
        let lines: Vec<u8> =
            (0..7 * 41).map(|i| if i % 41 == 0 { (i / 41 % 5) as u8 } else { i as u8 }).collect();
        seeds.push([&[1, 7, 5, depth, colour, 0, 6], &lines[..]].concat());
        let mut file = vec![];
        let mut encoder = png::Encoder::new(&mut file, 5, 7);
        let kind = png::ColorType::from_u8(colour).expect("a colour");
        encoder.set_color(kind);
        let depth = png::BitDepth::from_u8(depth).expect("a depth");
        encoder.set_depth(depth);
        encoder.set_palette(vec![9; 768]);
        let mut writer = encoder.write_header().expect("a header");
        let bytes = (5 * kind.samples() * depth as usize).div_ceil(8) * 7;
        writer.write_image_data(&vec![0; bytes]).expect("an image");
        writer.finish().expect("a file");
        seeds.push(plain(7, 5, &file));
    }
    seeds
}

fuzz_target!(init: begin(seeds), |input: &[u8]| {
    let [how, height, width, rest @ ..] = input else { return };
    let file = match (how & 1, rest) {
        (0, rest) => rest.to_vec(),
        (_, [depth, colour, interlaced, palette, lines @ ..]) => {
            let palette = &lines[..usize::from(*palette).min(lines.len())];
            packed(*height, *width, [*depth, *colour, interlaced & 1], palette, lines)
        }
        _ => return,
    };
    let (height, width) = (usize::from(*height), usize::from(*width));
    run(|| {
        // There is no file: what stands in for its name is what the caller calls the image.
        if let Some(image) = judge(Path::new("row 3"), decode_png(&file, height, width, "row 3")) {
            assert_eq!((image.height, image.width, image.data.len()), (height, width, height * width * 3));
        }
    });
});

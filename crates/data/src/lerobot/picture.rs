//! Images as PNG files, which is how they lie in Parquet columns.

use crate::Result;
use crate::file::{file_error, unsupported};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// What JPEG files begin with.
const JPEG: &[u8] = &[0xff, 0xd8, 0xff];
/// What files of other formats begin with, which are whole and not read here.
const OTHERS: [(&[u8], &str); 5] =
    [(b"RIFF", "WebP"), (b"GIF8", "GIF"), (b"BM", "BMP"), (b"II*\0", "TIFF"), (b"MM\0*", "TIFF")];
/// Bytes that one byte of a PNG file makes at most, by how it is packed.
const DENSEST: usize = 1032;
/// Bytes of pixels that no file is refused for.
const SMALL: usize = 1 << 16;

/// An RGB image, 8 bits per channel, as a PNG file.
///
/// # Shapes
/// `data` (height, width, 3).
///
/// # Errors
/// When the bytes do not fill the image.
pub fn encode(height: usize, width: usize, data: &[u8]) -> Result<Vec<u8>> {
    let bad =
        |found: String| super::table::column_error("image", format!("{height} x {width} x 3 bytes"), found);
    let side = |n: usize| u32::try_from(n).map_err(|e| bad(e.to_string()));
    if data.len() != height * width * 3 {
        return Err(bad(format!("{} bytes", data.len())));
    }
    let mut bytes = vec![];
    let mut encoder = png::Encoder::new(&mut bytes, side(width)?, side(height)?);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    // Frames are written once a step while recording: a tenth more bytes for a fraction of the time.
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(|e| bad(e.to_string()))?;
    writer.write_image_data(data).map_err(|e| bad(e.to_string()))?;
    writer.finish().map_err(|e| bad(e.to_string()))?;
    Ok(bytes)
}

/// The image in a PNG or JPEG file of known size, as a column holds them. Grey becomes RGB, transparency is dropped.
///
/// # Errors
/// When it is neither or of another size; `what` says which one it is.
pub fn decode_image(file: &[u8], height: usize, width: usize, what: &str) -> Result<e2h_core::Image> {
    let data = decode(file, height, width, Path::new("(dataset)"), what)?;
    Ok(e2h_core::Image { height, width, data })
}

/// The pixels of a PNG or JPEG file of known size. Grey becomes RGB, transparency is dropped, 16 bits become 8.
///
/// # Shapes
/// The result is (height, width, 3).
///
/// # Errors
/// When it is damaged or of another size, or by another kind when it is a file of another format; `path` and `what` say
/// where it lay.
pub(super) fn decode(bytes: &[u8], height: usize, width: usize, path: &Path, what: &str) -> Result<Vec<u8>> {
    if bytes.starts_with(JPEG) {
        return decode_jpeg(bytes, height, width, path, what);
    }
    if let Some((_, name)) = OTHERS.iter().find(|(magic, _)| bytes.starts_with(magic)) {
        return Err(unsupported(path, what, "a PNG or JPEG image", format!("a {name} file")));
    }
    let bad = |found: String| file_error(path, what, format!("a PNG image of {height} x {width}"), found);
    let broken = |e: png::DecodingError| bad(e.to_string());
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let header = decoder.read_header_info().map_err(broken)?;
    // The size before any pixel: a file of a few bytes may promise gigabytes.
    if (header.height as usize, header.width as usize) != (height, width) {
        return Err(bad(format!("{} x {}", header.height, header.width)));
    }
    let mut reader = decoder.read_info().map_err(broken)?;
    if reader.info().raw_bytes() > bytes.len().saturating_mul(DENSEST).saturating_add(SMALL) {
        return Err(bad(format!("{} bytes, too few for it", bytes.len())));
    }
    // The decoder cuts a palette into colours without a look at its length, and panics.
    if let Some(palette) = reader.info().palette.as_ref().filter(|p| p.len() % 3 != 0 || p.len() > 256 * 3) {
        return Err(bad(format!("a palette of {} bytes, which is not up to 256 colours", palette.len())));
    }
    let size = reader.output_buffer_size().ok_or_else(|| bad("more pixels than memory".to_owned()))?;
    let mut data = vec![0; size];
    let frame = reader.next_frame(&mut data).map_err(broken)?;
    data.truncate(frame.buffer_size());
    let rgb: Vec<u8> = match frame.color_type {
        png::ColorType::Rgb => data,
        png::ColorType::Rgba => data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
        png::ColorType::Grayscale => data.iter().flat_map(|&p| [p; 3]).collect(),
        png::ColorType::GrayscaleAlpha => data.chunks_exact(2).flat_map(|p| [p[0]; 3]).collect(),
        png::ColorType::Indexed => return Err(bad("a palette that was not applied".to_owned())),
    };
    if rgb.len() == height * width * 3 { Ok(rgb) } else { Err(bad(format!("{} bytes of pixels", rgb.len()))) }
}

/// As [`decode`], of a JPEG file.
fn decode_jpeg(bytes: &[u8], height: usize, width: usize, path: &Path, what: &str) -> Result<Vec<u8>> {
    let bad = |found: String| file_error(path, what, format!("a JPEG image of {height} x {width}"), found);
    let run = || {
        let options = DecoderOptions::new_safe().jpeg_set_out_colorspace(ColorSpace::RGB);
        let options = options.set_strict_mode(true).set_max_width(width).set_max_height(height);
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        // The size before any pixel: a file of a few bytes may promise gigabytes.
        decoder.decode_headers().map_err(|e| bad(e.to_string()))?;
        let found = decoder.dimensions().unwrap_or((0, 0));
        if found != (width, height) {
            return Err(bad(format!("{} x {}", found.1, found.0)));
        }
        let rgb = decoder.decode().map_err(|e| bad(e.to_string()))?;
        if rgb.len() == height * width * 3 {
            Ok(rgb)
        } else {
            Err(bad(format!("{} bytes of pixels", rgb.len())))
        }
    };
    // Not this project's decoder: damaged bytes may make it panic.
    catch_unwind(AssertUnwindSafe(run))
        .unwrap_or_else(|_| Err(bad("bytes that the decoder stumbles over".into())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn from(bytes: &[u8], height: usize, width: usize) -> Result<Vec<u8>> {
        decode(bytes, height, width, Path::new("x"), "row 0")
    }

    #[test]
    fn pixels_survive_and_sizes_are_checked() {
        let data: Vec<u8> = (0..4 * 6 * 3).map(|i| (i * 37) as u8).collect();
        let png = encode(4, 6, &data).unwrap();
        assert_eq!(from(&png, 4, 6).unwrap(), data);
        let message = from(&png, 6, 4).unwrap_err().to_string();
        assert_eq!(message, "x: row 0: expected a PNG image of 6 x 4, found 4 x 6");
        assert!(encode(4, 6, &data[1..]).is_err());
        assert!(from(b"\xff\xd8\xff\xe0 JFIF", 4, 6).is_err());
    }

    /// Made with Pillow 12: `Image.new("RGB", (12, 8), (200, 100, 50)).save("plain.jpg", quality=90)`.
    #[test]
    fn jpeg_files_are_read_and_other_formats_are_named() {
        let file = include_bytes!("../../../../tests/golden/lerobot/packed/plain.jpg");
        let pixels = from(file, 8, 12).unwrap();
        assert_eq!(pixels.len(), 8 * 12 * 3);
        for pixel in pixels.chunks_exact(3) {
            assert!(pixel.iter().zip([200_u8, 100, 50]).all(|(a, b)| a.abs_diff(b) < 4), "{pixel:?}");
        }
        let other = from(file, 12, 8).unwrap_err();
        assert!(!other.is_unsupported(), "{other}");
        for length in 0..file.len() {
            // What is cut off in the middle of its pixels may be an image all the same, of the size that is asked for.
            if let Ok(pixels) = from(&file[..length], 8, 12) {
                assert_eq!(pixels.len(), 8 * 12 * 3);
            }
        }
        let webp = from(b"RIFF\x24\0\0\0WEBPVP8 ", 8, 12).unwrap_err();
        assert!(webp.is_unsupported() && webp.to_string().contains("found a WebP file"), "{webp}");
        assert!(!from(b"nothing", 8, 12).unwrap_err().is_unsupported());
    }

    #[test]
    fn other_kinds_of_png_become_rgb() {
        for (kind, depth, data) in [
            (png::ColorType::Grayscale, png::BitDepth::Eight, vec![7, 9]),
            (png::ColorType::GrayscaleAlpha, png::BitDepth::Eight, vec![7, 0, 9, 255]),
            (png::ColorType::Rgba, png::BitDepth::Eight, vec![7, 7, 7, 1, 9, 9, 9, 2]),
            (png::ColorType::Grayscale, png::BitDepth::Sixteen, vec![7, 200, 9, 10]),
        ] {
            let mut bytes = vec![];
            let mut encoder = png::Encoder::new(&mut bytes, 2, 1);
            encoder.set_color(kind);
            encoder.set_depth(depth);
            let mut writer = encoder.write_header().unwrap();
            writer.write_image_data(&data).unwrap();
            writer.finish().unwrap();
            assert_eq!(from(&bytes, 1, 2).unwrap(), [7, 7, 7, 9, 9, 9], "{kind:?} {depth:?}");
        }
    }

    #[test]
    fn a_palette_that_is_not_of_whole_colours_is_refused() {
        let indexed = |palette: &[u8]| {
            let mut bytes = vec![];
            let mut encoder = png::Encoder::new(&mut bytes, 2, 1);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_palette(palette.to_vec());
            let mut writer = encoder.write_header().unwrap();
            writer.write_image_data(&[0, 1]).unwrap();
            writer.finish().unwrap();
            bytes
        };
        assert_eq!(from(&indexed(&[1, 2, 3, 4, 5, 6]), 1, 2).unwrap(), [1, 2, 3, 4, 5, 6]);
        for palette in [&[7; 5][..], &[7; 7], &[7; 257 * 3]] {
            let message = from(&indexed(palette), 1, 2).unwrap_err().to_string();
            assert!(message.starts_with("x: row 0: expected a PNG image of 1 x 2"), "{message}");
        }
    }

    #[test]
    fn a_file_that_promises_too_much_is_refused_before_its_pixels() {
        let mut png = encode(1, 1, &[1, 2, 3]).unwrap();
        png[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
        assert!(from(&png, 1, 1).is_err());
        // The size that is asked for, and next to nothing behind it.
        let whole = encode(4000, 4000, &vec![7; 4000 * 4000 * 3]).unwrap();
        assert_eq!(from(&whole, 4000, 4000).unwrap().len(), 4000 * 4000 * 3);
        let message = from(&whole[..100], 4000, 4000).unwrap_err().to_string();
        assert_eq!(message, "x: row 0: expected a PNG image of 4000 x 4000, found 100 bytes, too few for it");
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_or_images(at in 0_usize..200, value: u8, keep in 0_usize..200) {
            let data: Vec<u8> = (0..5 * 5 * 3).map(|i| (i * 91) as u8).collect();
            let mut png = encode(5, 5, &data).unwrap();
            let at = at % png.len();
            png[at] = value;
            png.truncate(keep.max(1));
            if let Ok(found) = from(&png, 5, 5) {
                prop_assert_eq!(found.len(), 75);
            }
        }
    }
}

//! Still pictures: PNG bytes, and how bytes become part of a page.

use crate::{Error, Result};
use e2h_core::Image;

/// A width or height as PNG stores it; what does not fit is refused by the encoder.
pub(crate) fn side(pixels: usize) -> u32 {
    u32::try_from(pixels).unwrap_or(u32::MAX)
}

/// Refuses an image whose bytes do not fill it.
pub(crate) fn check(image: &Image) -> Result<()> {
    let expected = image.height * image.width * 3;
    if image.data.len() == expected {
        return Ok(());
    }
    Err(Error::ImageBytes { height: image.height, width: image.width, expected, found: image.data.len() })
}

/// One image as an RGB8 PNG file.
///
/// # Errors
/// When the bytes do not fill the image or a side is zero.
pub fn png_bytes(image: &Image) -> Result<Vec<u8>> {
    check(image)?;
    let failed = |source| Error::Encode { picture: "a PNG image", source };
    let mut bytes = vec![];
    let mut encoder = png::Encoder::new(&mut bytes, side(image.width), side(image.height));
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&image.data).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// `data:` address of a PNG or APNG file.
pub(crate) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64(png))
}

pub(crate) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = (0..3).fold(0, |w, i| w << 8 | usize::from(chunk.get(i).copied().unwrap_or(0)));
        for digit in 0..4 {
            // n bytes make n + 1 digits; the rest of a last group is padding.
            let full = digit <= chunk.len();
            text.push(if full { DIGITS[word >> (18 - 6 * digit) & 63] as char } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_matches_rfc_4648() {
        for (plain, coded) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
        assert_eq!(base64(&[0xfb, 0xff]), "+/8=");
    }

    #[test]
    fn short_images_are_refused() {
        let image = Image { height: 2, width: 2, data: vec![0; 11] };
        assert!(matches!(png_bytes(&image), Err(Error::ImageBytes { expected: 12, found: 11, .. })));
    }
}

use crate::{Error, Result};
use e2h_core::Image;

/// The image in another size: every new pixel is the mean of the area that it covers.
///
/// # Shapes
/// (H, W, 3) to (`height`, `width`, 3). The sides are scaled one by one: a wide image becomes a square one whole.
///
/// # Errors
/// When a size is 0, or the bytes do not fill the image.
pub fn resize_image(image: &Image, height: usize, width: usize) -> Result<Image> {
    if image.height * image.width * height * width == 0 || image.data.len() != image.height * image.width * 3
    {
        return Err(Error::Column {
            column: "image".to_owned(),
            expected: format!("pixels to make {height} x {width} of"),
            found: format!("{} x {} ({} bytes)", image.height, image.width, image.data.len()),
        });
    }
    if (image.height, image.width) == (height, width) {
        return Ok(image.clone());
    }
    let (rows, columns) = (shares(image.height, height), shares(image.width, width));
    let mut data = Vec::with_capacity(height * width * 3);
    for row in &rows {
        for column in &columns {
            let mut sum = [0.0_f32; 3];
            for &(y, share_y) in row {
                for &(x, share_x) in column {
                    let at = (y * image.width + x) * 3;
                    for (s, &v) in sum.iter_mut().zip(&image.data[at..at + 3]) {
                        *s += share_y * share_x * f32::from(v);
                    }
                }
            }
            // A mean of bytes.
            data.extend(sum.map(|v| v.round() as u8));
        }
    }
    Ok(Image { height, width, data })
}

/// For each of `to` new pixels along a side of `from`: the old ones under it, and how much of it each covers.
fn shares(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    // In units in which old pixels are `to` long and new ones `from`: whole numbers.
    let under = |new: usize| {
        let (start, end) = (new * from, (new + 1) * from);
        let covered = |old: usize| {
            let common = end.min((old + 1) * to) - start.max(old * to);
            (old, common as f32 / from as f32)
        };
        (start / to..end.div_ceil(to)).map(covered).collect()
    };
    (0..to).map(under).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn halves_are_means_and_thirds_are_weighted() {
        let pixel = |v: u8| [v, 0, 255 - v];
        let image = Image { height: 1, width: 4, data: [0, 10, 100, 200].map(pixel).concat() };
        assert_eq!(resize_image(&image, 1, 2).unwrap().data, [pixel(5), pixel(150)].concat());
        // A third of 4 pixels: the first whole and a third of the second.
        let third = resize_image(&image, 2, 3).unwrap();
        assert_eq!((third.height, third.data.len()), (2, 18));
        assert_eq!(third.data[0], 3, "(0 * 3 + 10) / 4 = 2.5");
        assert_eq!(third.data[..9], third.data[9..]);
        assert!(resize_image(&image, 0, 3).is_err());
        assert!(resize_image(&Image { width: 5, ..image }, 1, 1).is_err());
    }

    proptest! {
        #[test]
        fn one_colour_stays_and_the_mean_nearly(h in 1_usize..9, w in 1_usize..9, to_h in 1_usize..9, to_w in 1_usize..9, v: u8) {
            let flat = Image { height: h, width: w, data: vec![v; h * w * 3] };
            let small = resize_image(&flat, to_h, to_w).unwrap();
            prop_assert!(small.data.iter().all(|&x| x == v) && small.data.len() == to_h * to_w * 3);
            let data: Vec<u8> = (0..h * w * 3).map(|i| (i * 97 + usize::from(v)) as u8).collect();
            let mean = |d: &[u8]| d.iter().map(|&x| f64::from(x)).sum::<f64>() / d.len() as f64;
            let other = resize_image(&Image { height: h, width: w, data: data.clone() }, to_h, to_w).unwrap();
            prop_assert!((mean(&other.data) - mean(&data)).abs() <= 0.51);
        }
    }
}

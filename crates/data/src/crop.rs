use crate::{Error, Result};
use e2h_core::Rng;
use rand::Rng as _;

/// Where a square crop lies in an image. Units: pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Crop {
    /// First row.
    pub top: usize,
    /// First column.
    pub left: usize,
    /// Side of the square.
    pub size: usize,
}

impl Crop {
    /// Anywhere in the image, every place as likely; for training.
    ///
    /// # Errors
    /// When the crop is larger than the image.
    pub fn random(height: usize, width: usize, size: usize, rng: &mut Rng) -> Result<Self> {
        let (down, right) = room(height, width, size)?;
        // 32 bits, so that 32-bit machines draw the same numbers.
        let mut draw = |most: usize| rng.random_range(0..=u32::try_from(most).unwrap_or(u32::MAX)) as usize;
        Ok(Self { top: draw(down), left: draw(right), size })
    }

    /// In the middle, towards the top left where it cannot be exact; for acting.
    ///
    /// # Errors
    /// When the crop is larger than the image.
    pub fn centre(height: usize, width: usize, size: usize) -> Result<Self> {
        let (down, right) = room(height, width, size)?;
        Ok(Self { top: down / 2, left: right / 2, size })
    }

    /// Rows of the crop in an image `width` pixels wide, as ranges of bytes of (H, W, 3) data.
    pub fn rows(self, width: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
        let start = move |row| ((self.top + row) * width + self.left) * 3;
        (0..self.size).map(move |row| start(row)..start(row) + self.size * 3)
    }
}

fn room(height: usize, width: usize, size: usize) -> Result<(usize, usize)> {
    match (height.checked_sub(size), width.checked_sub(size)) {
        (Some(down), Some(right)) => Ok((down, right)),
        _ => Err(Error::Crop { height, width, size }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_core::stream;

    #[test]
    fn random_crops_reach_every_place_and_leave_the_image_nowhere() {
        let mut rng = stream(1, "crop", 0, 0);
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..500 {
            let crop = Crop::random(6, 5, 4, &mut rng).unwrap();
            assert!(crop.top + 4 <= 6 && crop.left + 4 <= 5);
            seen.insert((crop.top, crop.left));
        }
        assert_eq!(seen.len(), 3 * 2);
    }

    #[test]
    fn rows_are_byte_ranges_of_the_image() {
        let crop = Crop::centre(4, 6, 2).unwrap();
        assert_eq!(crop, Crop { top: 1, left: 2, size: 2 });
        assert_eq!(crop.rows(6).collect::<Vec<_>>(), [24..30, 42..48]);
        let message = Crop::centre(4, 6, 5).unwrap_err().to_string();
        assert_eq!(message, "crop: expected at most the image, 4 x 6, found 5 x 5");
    }
}

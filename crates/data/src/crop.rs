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

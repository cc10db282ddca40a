//! The animation of an episode: all cameras side by side, as many pictures as the page has room for.

use super::recording::Recording;
use super::{Options, Source};
use crate::Result;
use crate::animation::{apng_bytes, hstack};
use crate::png_bytes;
use crate::png_image::data_uri;
use e2h_core::Image;

/// Tallest picture in an animation, pixels; taller ones are made smaller.
const TALLEST: usize = 120;
/// Height of the pictures in an episode's line, pixels.
const THUMBNAIL: usize = 48;
/// Share of the page's size that animations may take.
const SHARE: f64 = 0.62;
/// Base64 has four letters for three bytes.
const BASE64: f64 = 4.0 / 3.0;
/// A change of a channel up to this is not shown, of 255: the noise of a real camera is most of an animation's bytes.
const STILL: u8 = 6;
/// What a page needs besides episodes, bytes.
const FRAME: f64 = 60_000.0;

/// The pictures of one episode.
pub(super) struct Film {
    /// `data:` addresses: the animation, the first and the last picture.
    pub(super) animation: String,
    pub(super) first: String,
    pub(super) last: String,
    /// Row of each picture.
    pub(super) rows: Vec<usize>,
    pub(super) cameras: Vec<String>,
    /// Sides of the animation, pixels.
    pub(super) size: (usize, usize),
}

/// Makes the films of a page within its size.
pub(super) struct Films {
    stride: usize,
    limit: f64,
    without: usize,
    shrunk: bool,
    with: usize,
}

impl Films {
    /// Looks at three episodes to find how many rows apart pictures have to be.
    pub(super) fn plan(source: &Source, chosen: &[usize], rows: usize, options: &Options) -> Self {
        let limit = options.megabytes * 1e6 - FRAME;
        let mut this =
            Self { stride: options.stride.unwrap_or(2), limit, without: 0, shrunk: false, with: 0 };
        if options.stride.is_some() {
            return this;
        }
        let samples = super::spread(chosen.len(), 3);
        let samples: Vec<Recording> =
            samples.iter().filter_map(|&i| source.read(*chosen.get(i)?).ok()).collect();
        // Pictures further apart differ more and cost more each: twice is near enough.
        for _ in 0..2 {
            let costs = samples.iter().filter_map(|r| this.film(r).ok().flatten());
            let cost =
                |f: Film| (f.animation.len() + f.first.len() + f.last.len()) as f64 / f.rows.len() as f64;
            let cost = costs.map(cost).fold(0.0, f64::max) * 1.1;
            if cost > 0.0 {
                let pictures = (options.megabytes * 1e6 * SHARE / cost).max(1.0);
                // Positive, and small.
                let stride = (rows as f64 / pictures).ceil() as usize;
                this.stride = stride.max(1);
            }
        }
        this
    }

    /// The film of an episode; none without cameras, or when there is no room left on a page of `used` bytes.
    pub(super) fn make(&mut self, recording: &Recording, used: usize) -> Result<Option<Film>> {
        let Some(film) = self.film(recording)? else { return Ok(None) };
        let size = film.animation.len() + film.first.len() + film.last.len();
        if (used + size) as f64 > self.limit {
            self.without += 1;
            return Ok(None);
        }
        self.with += 1;
        self.shrunk |= recording.cameras.iter().any(|c| c.height > TALLEST);
        Ok(Some(film))
    }

    fn film(&self, recording: &Recording) -> Result<Option<Film>> {
        let last = recording.rows.saturating_sub(1);
        let rows: Vec<usize> = (0..recording.rows).filter(|t| t % self.stride == 0 || *t == last).collect();
        if recording.cameras.is_empty() || rows.is_empty() {
            return Ok(None);
        }
        let mut frames: Vec<Image> = Vec::with_capacity(rows.len());
        for &row in &rows {
            let images = recording.cameras.iter().map(|c| Ok(shrink(&c.image(row)?, TALLEST)));
            let mut image = hstack(&images.collect::<Result<Vec<_>>>()?);
            if let Some(before) = frames.last() {
                settle(&mut image, before);
            }
            frames.push(image);
        }
        // Between 1 and 100.
        let fps = (recording.hz / self.stride as f64).round().clamp(1.0, 100.0) as u16;
        let thumbnail = |i: usize| -> Result<String> {
            let Some(camera) = recording.cameras.first() else { return Ok(String::new()) };
            Ok(data_uri(&png_bytes(&shrink(&camera.image(rows[i])?, THUMBNAIL))?))
        };
        Ok(Some(Film {
            animation: data_uri(&apng_bytes(&frames, fps)?),
            first: thumbnail(0)?,
            last: thumbnail(rows.len() - 1)?,
            cameras: recording.cameras.iter().map(|c| c.name.clone()).collect(),
            size: frames.first().map_or((0, 0), |f| (f.height, f.width)),
            rows,
        }))
    }

    /// What the animations do not show, in sentences.
    pub(super) fn left_out(&self) -> Vec<String> {
        let mut text = vec![];
        if self.with > 0 && self.stride > 1 {
            text.push(format!(
                "Animations show every {} row; --stride and --megabytes change that.",
                ordinal(self.stride)
            ));
        }
        if self.with > 0 {
            text.push(format!("Changes of up to {STILL} of 255 from picture to picture are not shown."));
        }
        if self.shrunk {
            text.push(format!("Pictures are at most {TALLEST} pixels high, episodes have larger ones."));
        }
        if self.without > 0 {
            text.push(format!(
                "{} episodes are without pictures, because the page would be too large.",
                self.without
            ));
        }
        text
    }

    /// Bytes that plots may take of a page, all episodes together.
    pub(super) fn room_for_plots(megabytes: f64) -> f64 {
        megabytes * 1e6 * (1.0 - SHARE) * 0.8 / BASE64
    }
}

/// 2nd, 3rd, 21st.
pub(super) fn ordinal(n: usize) -> String {
    let end = match (n % 10, n % 100) {
        (1, r) if r != 11 => "st",
        (2, r) if r != 12 => "nd",
        (3, r) if r != 13 => "rd",
        _ => "th",
    };
    format!("{n}{end}")
}

/// Pixels that hardly differ from the picture before become it.
fn settle(image: &mut Image, before: &Image) {
    if image.data.len() != before.data.len() {
        return;
    }
    for (now, old) in image.data.chunks_exact_mut(3).zip(before.data.chunks_exact(3)) {
        if now.iter().zip(old).all(|(a, b)| a.abs_diff(*b) <= STILL) {
            now.copy_from_slice(old);
        }
    }
}

/// The image at most `tallest` pixels high, each pixel the mean of those that it replaces.
fn shrink(image: &Image, tallest: usize) -> Image {
    if image.height <= tallest || image.data.len() != image.height * image.width * 3 {
        return image.clone();
    }
    let (height, width) = (tallest, (image.width * tallest / image.height).max(1));
    let mut data = Vec::with_capacity(height * width * 3);
    let span = |i: usize, new: usize, old: usize| i * old / new..((i + 1) * old).div_ceil(new);
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut n) = ([0_usize; 3], 0);
            for row in span(y, height, image.height) {
                for column in span(x, width, image.width) {
                    let at = (row * image.width + column) * 3;
                    for (s, v) in sum.iter_mut().zip(&image.data[at..at + 3]) {
                        *s += usize::from(*v);
                    }
                    n += 1;
                }
            }
            data.extend(sum.map(|s| u8::try_from((s + n / 2) / n.max(1)).unwrap_or(u8::MAX)));
        }
    }
    Image { height, width, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_smaller_image_has_the_means() {
        let data = (0..4 * 6).flat_map(|i| [i as u8 * 10, 7, 0]).collect();
        let small = shrink(&Image { height: 4, width: 6, data }, 2);
        assert_eq!((small.height, small.width, small.data.len()), (2, 3, 18));
        assert_eq!(small.data[..3], [35, 7, 0]); // pixels 0, 1, 6 and 7
        let same = Image { height: 2, width: 1, data: vec![1; 6] };
        assert_eq!(shrink(&same, 2), same);
    }

    #[test]
    fn noise_settles_and_motion_does_not() {
        let before = Image { height: 1, width: 2, data: vec![100, 100, 100, 50, 50, 50] };
        let mut now = Image { height: 1, width: 2, data: vec![106, 94, 100, 50, 57, 50] };
        settle(&mut now, &before);
        assert_eq!(now.data, [100, 100, 100, 50, 57, 50]);
    }

    #[test]
    fn ordinals() {
        assert_eq!(
            [1, 2, 3, 4, 11, 22, 113].map(ordinal),
            ["1st", "2nd", "3rd", "4th", "11th", "22nd", "113th"]
        );
    }
}

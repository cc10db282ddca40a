//! Animated PNGs of rollouts, and how images are put together.

use crate::png_image::{check, side};
use crate::{Error, Result};
use e2h_core::{Episode, Image, Outcome};
use e2h_data::write_atomic;
use std::path::Path;

const SUCCESS: [u8; 3] = [46, 160, 82];
const FAILURE: [u8; 3] = [208, 62, 62];
const UNKNOWN: [u8; 3] = [140, 148, 158];
const BACKGROUND: [u8; 3] = [24, 28, 34];

/// Writes an animated PNG that plays for ever; see [`apng_bytes`].
///
/// # Errors
/// As [`apng_bytes`], and [`Error::Io`] with the path.
pub fn write_apng(path: &Path, frames: &[Image], fps: u16) -> Result<()> {
    let bytes =
        apng_bytes(frames, fps).map_err(|e| Error::Picture { path: path.to_owned(), source: Box::new(e) })?;
    Ok(write_atomic(path, &bytes)?)
}

/// An animated PNG that plays for ever and holds its last frame for a second.
///
/// Only the rectangle that changed is stored, with unchanged pixels transparent, so that a still background costs
/// nothing; what is shown is exactly `frames`.
///
/// # Units
/// `fps` frames a second; 0 counts as 1.
///
/// # Errors
/// Without frames, when they differ in size, or when bytes do not fill an image.
pub fn apng_bytes(frames: &[Image], fps: u16) -> Result<Vec<u8>> {
    let failed = |source| Error::Encode { picture: "an animated PNG", source };
    let first = frames.first().ok_or(Error::NoFrames)?;
    let fps = fps.max(1);
    for (index, frame) in frames.iter().enumerate() {
        check(frame)?;
        let (expected, found) = ((first.height, first.width), (frame.height, frame.width));
        if expected != found {
            return Err(Error::FrameSize { index, expected, found });
        }
    }
    let mut bytes = vec![];
    let mut encoder = png::Encoder::new(&mut bytes, side(first.width), side(first.height));
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_animated(side(frames.len()), 0).map_err(failed)?;
    encoder.set_frame_delay(1, fps).map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    for (index, frame) in frames.iter().enumerate() {
        if index + 1 == frames.len() {
            writer.set_frame_delay(fps, fps).map_err(failed)?;
        }
        let before = index.checked_sub(1).map(|i| &frames[i]);
        let area = before.map_or(Area { x: 0, y: 0, w: frame.width, h: frame.height }, |b| changed(b, frame));
        // The position is checked against the size set before it, so the size is made minimal first.
        writer.set_frame_dimension(1, 1).map_err(failed)?;
        writer.set_frame_position(side(area.x), side(area.y)).map_err(failed)?;
        writer.set_frame_dimension(side(area.w), side(area.h)).map_err(failed)?;
        let blend = if before.is_some() { png::BlendOp::Over } else { png::BlendOp::Source };
        writer.set_blend_op(blend).map_err(failed)?;
        writer.write_image_data(&difference(before, frame, &area)).map_err(failed)?;
    }
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

struct Area {
    x: usize,
    y: usize,
    w: usize,
    h: usize,
}

fn pixel(image: &Image, x: usize, y: usize) -> &[u8] {
    let at = (y * image.width + x) * 3;
    &image.data[at..at + 3]
}

/// Smallest rectangle that holds every changed pixel; one pixel when nothing changed, as a frame cannot be empty.
fn changed(a: &Image, b: &Image) -> Area {
    let (mut left, mut right, mut top, mut bottom) = (usize::MAX, 0, usize::MAX, 0);
    for y in 0..b.height {
        for x in (0..b.width).filter(|&x| pixel(a, x, y) != pixel(b, x, y)) {
            (left, right, top, bottom) = (left.min(x), right.max(x), top.min(y), bottom.max(y));
        }
    }
    if left > right {
        return Area { x: 0, y: 0, w: 1, h: 1 };
    }
    Area { x: left, y: top, w: right - left + 1, h: bottom - top + 1 }
}

/// RGBA bytes of `area`; pixels that equal those before are transparent black, which deflates to almost nothing.
fn difference(before: Option<&Image>, frame: &Image, area: &Area) -> Vec<u8> {
    let mut data = Vec::with_capacity(area.w * area.h * 4);
    for y in area.y..area.y + area.h {
        for x in area.x..area.x + area.w {
            let rgb = pixel(frame, x, y);
            if before.is_some_and(|b| pixel(b, x, y) == rgb) {
                data.extend_from_slice(&[0; 4]);
            } else {
                data.extend_from_slice(rgb);
                data.push(255);
            }
        }
    }
    data
}

/// Images of one camera of an episode, each `every`-th row and the last; empty when there is no such camera.
///
/// # Errors
/// When an image lies on the disk and cannot be read.
pub fn episode_frames(episode: &Episode, camera: usize, every: usize) -> Result<Vec<Image>> {
    let last = episode.len().saturating_sub(1);
    let rows = (0..episode.len()).filter(|t| t % every.max(1) == 0 || *t == last);
    pick(episode, camera, rows)
}

/// `count` images of one camera, evenly spread over the episode from its first row to its last.
///
/// # Errors
/// When an image lies on the disk and cannot be read.
pub fn sampled_frames(episode: &Episode, camera: usize, count: usize) -> Result<Vec<Image>> {
    pick(episode, camera, (0..count).map(|i| sample_row(i, count, episode.len())))
}

/// Row that sample `i` of `count` shows in an episode of `rows` rows.
pub(crate) fn sample_row(i: usize, count: usize, rows: usize) -> usize {
    let gaps = count.saturating_sub(1).max(1);
    (i * rows.saturating_sub(1) + gaps / 2) / gaps
}

fn pick(episode: &Episode, camera: usize, rows: impl Iterator<Item = usize>) -> Result<Vec<Image>> {
    let Some(f) = episode.frames.get(camera).filter(|_| !episode.is_empty()) else { return Ok(vec![]) };
    rows.map(|t| Ok(Image { height: f.height, width: f.width, data: f.image(t)?.into_owned() })).collect()
}

/// `image` with each pixel drawn `k` x `k` times; `k` = 0 counts as 1.
///
/// # Shapes
/// (H, W, 3) to (k H, k W, 3).
#[must_use]
pub fn scale(image: &Image, k: usize) -> Image {
    let k = k.max(1);
    let mut data = Vec::with_capacity(image.data.len() * k * k);
    for row in image.data.chunks_exact((image.width * 3).max(1)) {
        let wide: Vec<u8> = row.chunks_exact(3).flat_map(|p| p.repeat(k)).collect();
        (0..k).for_each(|_| data.extend_from_slice(&wide));
    }
    Image { height: image.height * k, width: image.width * k, data }
}

/// Images side by side; lower ones are padded at the bottom.
///
/// # Shapes
/// (H_i, W_i, 3) to (max H_i, sum W_i, 3).
#[must_use]
pub fn hstack(images: &[Image]) -> Image {
    let height = images.iter().map(|i| i.height).max().unwrap_or(0);
    let mut canvas = filled(height, images.iter().map(|i| i.width).sum(), BACKGROUND);
    let mut x = 0;
    for image in images {
        paste(&mut canvas, image, x, 0);
        x += image.width;
    }
    canvas
}

/// Several rollouts as one animation in a grid of `columns` columns, in reading order. Shorter ones hold their last
/// frame; the border is green for a success, red for a failure and grey where `outcomes` says nothing.
///
/// # Shapes
/// A cell is the largest image plus a border of a 32nd of its width, at least 2 pixels.
#[must_use]
pub fn tile(trials: &[Vec<Image>], outcomes: &[Outcome], columns: usize) -> Vec<Image> {
    let columns = columns.clamp(1, trials.len().max(1));
    let images = || trials.iter().flatten();
    let (height, width) =
        (images().map(|i| i.height).max().unwrap_or(0), images().map(|i| i.width).max().unwrap_or(0));
    let border = (width / 32).max(2);
    let (cell_h, cell_w) = (height + 2 * border, width + 2 * border);
    let length = trials.iter().map(Vec::len).max().unwrap_or(0);
    let mut frames = vec![];
    for t in 0..length {
        let mut canvas = filled(trials.len().div_ceil(columns) * cell_h, columns * cell_w, BACKGROUND);
        for (i, trial) in trials.iter().enumerate() {
            let (x, y) = (i % columns * cell_w, i / columns * cell_h);
            let colour = outcomes.get(i).map_or(UNKNOWN, |o| if o.is_success() { SUCCESS } else { FAILURE });
            paste(&mut canvas, &filled(cell_h, cell_w, colour), x, y);
            paste(&mut canvas, &filled(height, width, BACKGROUND), x + border, y + border);
            if let Some(image) = trial.get(t).or(trial.last()) {
                paste(&mut canvas, image, x + border, y + border);
            }
        }
        frames.push(canvas);
    }
    frames
}

fn filled(height: usize, width: usize, colour: [u8; 3]) -> Image {
    Image { height, width, data: colour.repeat(height * width) }
}

/// Copies `image` into `canvas` at (x, y), which must leave room for it; missing bytes are left out.
fn paste(canvas: &mut Image, image: &Image, x: usize, y: usize) {
    for (row, bytes) in image.data.chunks_exact((image.width * 3).max(1)).take(image.height).enumerate() {
        let at = ((y + row) * canvas.width + x) * 3;
        if let Some(target) = canvas.data.get_mut(at..at + bytes.len()) {
            target.copy_from_slice(bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample;
    use std::io::Cursor;

    /// Plays an animated PNG as a viewer does: each frame is laid over the picture so far.
    fn play(bytes: &[u8]) -> (Vec<Image>, Vec<(u16, u16)>) {
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().unwrap();
        let (h, w) = (reader.info().height as usize, reader.info().width as usize);
        let count = reader.info().animation_control().unwrap().num_frames;
        let mut canvas = filled(h, w, [1, 2, 3]);
        let (mut frames, mut delays) = (vec![], vec![]);
        for _ in 0..count {
            let mut data = vec![0; reader.output_buffer_size().unwrap()];
            reader.next_frame(&mut data).unwrap();
            let f = *reader.info().frame_control().unwrap();
            assert_eq!(f.dispose_op, png::DisposeOp::None);
            for (i, p) in data.chunks_exact(4).take((f.width * f.height) as usize).enumerate() {
                let (x, y) = (i % f.width as usize, i / f.width as usize);
                let at = ((y + f.y_offset as usize) * w + x + f.x_offset as usize) * 3;
                if p[3] == 255 || f.blend_op == png::BlendOp::Source {
                    canvas.data[at..at + 3].copy_from_slice(&p[..3]);
                }
            }
            frames.push(canvas.clone());
            delays.push((f.delay_num, f.delay_den));
        }
        (frames, delays)
    }

    #[test]
    fn an_animation_decodes_to_its_frames() {
        let mut frames = sample::rollout(20, 64, 96, 1);
        frames.push(frames[19].clone()); // nothing changes
        frames.push(frames[0].clone()); // pixels go back
        let bytes = apng_bytes(&frames, 10).unwrap();
        let (played, delays) = play(&bytes);
        assert!(played == frames, "frames differ");
        assert_eq!(delays[0], (1, 10));
        assert_eq!(delays.last(), Some(&(10, 10)));
        let stills: usize = frames.iter().map(|f| crate::png_bytes(f).unwrap().len()).sum();
        assert!(bytes.len() * 2 < stills, "{} against {stills} bytes of stills", bytes.len());
        assert_eq!(bytes, apng_bytes(&frames, 10).unwrap());
    }

    #[test]
    fn one_frame_and_wrong_frames() {
        let frames = sample::rollout(2, 8, 8, 1);
        assert_eq!(play(&apng_bytes(&frames[..1], 0).unwrap()).0, frames[..1]);
        assert!(matches!(apng_bytes(&[], 10), Err(Error::NoFrames)));
        let mixed = [frames[0].clone(), scale(&frames[1], 2)];
        assert!(matches!(apng_bytes(&mixed, 10), Err(Error::FrameSize { index: 1, .. })));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        assert!(write_apng(&path, &[], 10).unwrap_err().to_string().contains("a.png"));
        write_apng(&path, &frames, 10).unwrap();
        assert_eq!(play(&std::fs::read(&path).unwrap()).0, frames);
    }

    #[test]
    fn tiles_hold_the_last_frame_and_show_the_outcome() {
        let trials =
            [sample::rollout(3, 8, 10, 1), sample::rollout(5, 8, 10, 2), sample::rollout(1, 8, 10, 3)];
        let outcomes = [Outcome::Success { at: 2 }, Outcome::Timeout];
        let frames = tile(&trials, &outcomes, 2);
        assert_eq!(frames.len(), 5);
        assert!(frames.iter().all(|f| (f.height, f.width) == (2 * 12, 2 * 14)));
        assert!(frames.iter().all(|f| f.data.len() == f.height * f.width * 3));
        let last = &frames[4];
        assert_eq!(pixel(last, 0, 0), SUCCESS);
        assert_eq!(pixel(last, 14, 0), FAILURE);
        assert_eq!(pixel(last, 0, 12), UNKNOWN);
        assert_eq!(pixel(last, 14, 12), BACKGROUND);
        assert_eq!(pixel(last, 2 + 5, 2 + 3), pixel(&trials[0][2], 5, 3));
        assert!(tile(&[], &[], 4).is_empty());
        assert_eq!(tile(&trials[..1], &[], 4)[0].width, 14);
    }

    #[test]
    fn scaling_and_stacking() {
        let a = Image { height: 1, width: 2, data: vec![1, 2, 3, 4, 5, 6] };
        let big = scale(&a, 2);
        assert_eq!((big.height, big.width), (2, 4));
        assert_eq!(big.data[..12], [1, 2, 3, 1, 2, 3, 4, 5, 6, 4, 5, 6]);
        let row = hstack(&[a.clone(), big.clone()]);
        assert_eq!((row.height, row.width, row.data.len()), (2, 6, 36));
        assert_eq!(pixel(&row, 1, 0), [4, 5, 6]);
        assert_eq!(pixel(&row, 1, 1), BACKGROUND);
        assert_eq!(pixel(&row, 5, 1), [4, 5, 6]);
    }

    #[test]
    fn samples_run_from_the_first_row_to_the_last() {
        let rows: Vec<usize> = (0..4).map(|i| sample_row(i, 4, 10)).collect();
        assert_eq!(rows, [0, 3, 6, 9]);
        assert_eq!((sample_row(0, 1, 10), sample_row(7, 8, 1)), (0, 0));
        let e = sample::episode(7);
        assert_eq!(episode_frames(&e, 0, 3).unwrap().len(), 3);
        assert_eq!(episode_frames(&e, 0, 4).unwrap().len(), 3);
        assert_eq!(sampled_frames(&e, 0, 5).unwrap().len(), 5);
        assert!(sampled_frames(&e, 9, 5).unwrap().is_empty());
    }
}

//! Frames of videos, decoded by the machine's `ffmpeg`. This project links no decoder.

use super::feature::Feature;
use super::picture;
use crate::file::file_error;
use crate::{Error, Result};
use std::ffi::OsString;
use std::io::{Read, Seek};
use std::path::Path;
use std::process::{Command, Stdio};

/// Names the decoder when it is not called `ffmpeg` or not on the path.
const PROGRAM: &str = "E2H_FFMPEG";

/// The program that decodes videos: `ffmpeg`, or what `E2H_FFMPEG` names.
#[must_use]
pub fn video_decoder() -> OsString {
    std::env::var_os(PROGRAM).filter(|p| !p.is_empty()).unwrap_or_else(|| "ffmpeg".into())
}

fn prefixed(prefix: &str, path: &Path) -> OsString {
    let mut whole = OsString::from(prefix);
    whole.push(path);
    whole
}

/// `count` frames from `from` seconds on, as PNG files.
pub(crate) fn read(
    path: &Path,
    from: f64,
    count: usize,
    fps: f64,
    feature: &Feature,
) -> Result<Vec<Vec<u8>>> {
    let Some((height, width)) = feature.image_size() else { return Ok(vec![]) };
    // Half a frame early, so that rounding of times does not skip the first frame.
    let start = (from - 0.5 / fps).max(0.0);
    let program = video_decoder();
    let failed = |found: String| Error::Video {
        path: path.to_owned(),
        needs: "the program `ffmpeg`, 5.1 or newer (or the one that E2H_FFMPEG names), to decode it",
        found,
    };
    let mut command = Command::new(&program);
    command.args(["-v", "error", "-nostdin", "-ss", &format!("{start:.6}")]);
    // As MP4, which is what LeRobot writes: left to itself ffmpeg goes by the content, and what it takes for a playlist may name
    // other files and addresses.
    command.args(["-protocol_whitelist", "file", "-f", "mp4", "-i"]).arg(prefixed("file:", path));
    command.args(["-frames:v", &count.to_string(), "-fps_mode", "passthrough"]);
    command.args(["-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]);
    // To a file: a pipe that nobody reads would fill up and stop the decoder.
    let mut said = tempfile::tempfile().map_err(|e| failed(e.to_string()))?;
    let stderr = said.try_clone().map_err(|e| failed(e.to_string()))?;
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(stderr)
        .spawn()
        .map_err(|e| failed(format!("{}: {e}", program.to_string_lossy())))?;
    let mut frames = vec![];
    let mut frame = vec![0; height * width * 3];
    if let Some(mut out) = child.stdout.take() {
        while frames.len() < count && out.read_exact(&mut frame).is_ok() {
            frames.push(picture::encode(height, width, &frame)?);
        }
    }
    let status = child.wait().map_err(|e| failed(e.to_string()))?;
    if frames.len() == count {
        return Ok(frames);
    }
    let mut text = vec![];
    let _ = said.rewind().and_then(|()| said.take(1000).read_to_end(&mut text));
    let text = String::from_utf8_lossy(&text);
    // What versions before 5.1 say of an option that they do not know.
    if text.contains("fps_mode") {
        return Err(failed(format!("an older one: {}", text.trim())));
    }
    let found = format!("{} ({status} {})", frames.len(), text.trim());
    Err(file_error(
        path,
        &format!("video from {from} s"),
        format!("{count} frames of {height} x {width}"),
        found,
    ))
}

//! Which rows each row of a result reads, as an index on the device.

use crate::kernel::conv::Geo;
use candle_core::{DType, Device, Result, Tensor};
use std::sync::{Mutex, PoisonError};

/// Rows to read: for each row of a sample's result one for every tap, or a border.
#[derive(Clone)]
pub(crate) struct Gather {
    /// None where every row reads itself alone.
    index: Option<Tensor>,
    /// Rows of a sample of the result.
    pub(crate) rows: usize,
    pub(crate) taps: usize,
    border: bool,
}

/// Kernels count elements in 32 bits.
const MOST: usize = u32::MAX as usize;

impl Gather {
    /// The rows under the taps, side by side; `border` where there is none.
    ///
    /// # Shapes
    /// `(B, R, C)` to `(B rows, taps C)`.
    pub(crate) fn take(&self, x: &Tensor, border: f32) -> Result<Tensor> {
        let (b, _, c) = x.dims3()?;
        let Some(index) = &self.index else { return x.reshape((b * self.rows, c)) };
        if b * self.rows * self.taps * c > MOST {
            let (rows, width) = (b * self.rows, self.taps * c);
            candle_core::bail!(
                "patches of a convolution: expected fewer than 2^32 numbers, found {rows} x {width}; take a smaller batch"
            );
        }
        let x = if self.border {
            let edge = Tensor::full(border, (b, 1, c), x.device())?.to_dtype(x.dtype())?;
            Tensor::cat(&[x, &edge], 1)?
        } else {
            x.clone()
        };
        x.contiguous()?.index_select(index, 1)?.reshape((b * self.rows, self.taps * c))
    }
}

/// For every output position of the convolution `g` the input rows under its taps.
pub(crate) fn under(g: &Geo, device: &Device) -> Result<Gather> {
    cached(Kind::Under, g, device)
}

/// For every input position the output rows that it has a part in, one per tap.
pub(crate) fn over(g: &Geo, device: &Device) -> Result<Gather> {
    cached(Kind::Over, g, device)
}

/// For every input position the places `output row * taps + tap` that read it.
pub(crate) fn readers(g: &Geo, device: &Device) -> Result<Gather> {
    cached(Kind::Readers, g, device)
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Under,
    Over,
    Readers,
}

type Key = (Kind, [usize; 8]);

/// Indices that were made, for as long as the process lives: a network has a few dozen.
static MADE: Mutex<Vec<(Key, Device, Gather)>> = Mutex::new(Vec::new());

fn cached(kind: Kind, g: &Geo, device: &Device) -> Result<Gather> {
    let key = (kind, [g.h, g.w, g.kh, g.kw, g.sh, g.sw, g.ph, g.pw]);
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, _, gather)) = made.iter().find(|(k, d, _)| *k == key && d.same_device(device)) {
        return Ok(gather.clone());
    }
    let gather = make(kind, g, device)?;
    made.push((key, device.clone(), gather.clone()));
    Ok(gather)
}

/// The input position under a tap of an output position along one axis, if inside.
fn inside(out: usize, tap: usize, stride: usize, padding: usize, size: usize) -> Option<usize> {
    (out * stride + tap).checked_sub(padding).filter(|i| *i < size)
}

/// The output position that reads input position `i` through a tap along one axis, if there is one.
fn reader(i: usize, tap: usize, stride: usize, padding: usize, out: usize) -> Option<usize> {
    let from = (i + padding).checked_sub(tap).filter(|f| f.is_multiple_of(stride))?;
    Some(from / stride).filter(|o| *o < out)
}

fn make(kind: Kind, g: &Geo, device: &Device) -> Result<Gather> {
    let (out_h, out_w, taps) = (g.out_h(), g.out_w(), g.kh * g.kw);
    let mut lists: Vec<Vec<Option<usize>>> = Vec::new();
    if kind == Kind::Under {
        for o in 0..out_h * out_w {
            let row = |t: usize| {
                let y = inside(o / out_w, t / g.kw, g.sh, g.ph, g.h)?;
                Some(y * g.w + inside(o % out_w, t % g.kw, g.sw, g.pw, g.w)?)
            };
            lists.push((0..taps).map(row).collect());
        }
    } else {
        for i in 0..g.h * g.w {
            let row = |t: usize| {
                let y = reader(i / g.w, t / g.kw, g.sh, g.ph, out_h)?;
                Some(y * out_w + reader(i % g.w, t % g.kw, g.sw, g.pw, out_w)?)
            };
            lists.push(if kind == Kind::Over {
                (0..taps).map(row).collect()
            } else {
                (0..taps).filter_map(|t| Some(Some(row(t)? * taps + t))).collect()
            });
        }
    }
    let border = match kind {
        Kind::Under => g.h * g.w,
        Kind::Over => out_h * out_w,
        Kind::Readers => out_h * out_w * taps,
    };
    let (rows, taps) = (lists.len(), lists.iter().map(Vec::len).max().unwrap_or(0));
    let mut index = Vec::with_capacity(rows * taps);
    for list in lists {
        let missing = taps - list.len();
        index.extend(list.into_iter().chain(std::iter::repeat_n(None, missing)).map(|i| i.unwrap_or(border)));
    }
    let has_border = index.contains(&border);
    let itself = taps == 1 && index.len() == border && index.iter().enumerate().all(|(i, j)| i == *j);
    if border > MOST {
        candle_core::bail!("positions of a convolution: expected fewer than 2^32, found {border}");
    }
    let index = index.into_iter().map(|i| i as u32).collect::<Vec<u32>>();
    let n = index.len();
    let index = if itself { None } else { Some(Tensor::from_vec(index, n, device)?.to_dtype(DType::U32)?) };
    Ok(Gather { index, rows, taps, border: has_border })
}

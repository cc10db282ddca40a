//! Which rows of its input every position of a convolution reads.

/// Sizes of a convolution from `(b, h, w, c)` to `(b, out_h, out_w, n)`. One dimension: `h` and `kh` are 1.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geo {
    pub(crate) b: usize,
    pub(crate) h: usize,
    pub(crate) w: usize,
    pub(crate) c: usize,
    pub(crate) n: usize,
    pub(crate) kh: usize,
    pub(crate) kw: usize,
    pub(crate) sh: usize,
    pub(crate) sw: usize,
    pub(crate) ph: usize,
    pub(crate) pw: usize,
}

impl Geo {
    /// A product of `rows` rows of `c` with a matrix of `c` by `n`.
    pub(crate) fn linear(rows: usize, c: usize, n: usize) -> Self {
        Self { b: rows, h: 1, w: 1, c, n, kh: 1, kw: 1, sh: 1, sw: 1, ph: 0, pw: 0 }
    }
    pub(crate) fn out_h(&self) -> usize {
        (self.h + 2 * self.ph).saturating_sub(self.kh) / self.sh + 1
    }
    pub(crate) fn out_w(&self) -> usize {
        (self.w + 2 * self.pw).saturating_sub(self.kw) / self.sw + 1
    }
    /// Output positions of one sample.
    pub(super) fn per(&self) -> usize {
        self.out_h() * self.out_w()
    }
    /// Output positions of all samples.
    pub(super) fn m(&self) -> usize {
        self.b * self.per()
    }
    /// Numbers of a sample of the input.
    pub(super) fn size(&self) -> usize {
        self.h * self.w * self.c
    }
    pub(super) fn taps(&self) -> usize {
        self.kh * self.kw
    }
    /// The padded input covers the kernel, or taps would lie outside it; and places in a sample fit [`narrow`].
    pub(super) fn check(&self) {
        let (h, w) = (self.h + 2 * self.ph, self.w + 2 * self.pw);
        assert!(self.sh > 0 && self.sw > 0 && self.taps() > 0, "strides and taps of {self:?}");
        assert!(self.kh <= h && self.kw <= w, "a kernel larger than the padded input: {self:?}");
        assert!(
            u32::try_from((h * w * self.c).max(self.per() * self.n)).is_ok(),
            "too large a sample: {self:?}"
        );
    }
}

/// The positions of a result that sum over the same taps.
pub(super) struct Class {
    pub(super) taps: Vec<usize>,
    /// For each tap, for each position: where the row begins in its sample, or none.
    pub(super) from: Vec<Option<u32>>,
    /// For each position: where its row begins in its sample of the result.
    pub(super) to: Vec<u32>,
}

impl Class {
    /// Calls `f(i, pointer)` for the row of tap number `t` that each of the rows `rows` of all samples reads.
    #[inline(always)]
    pub(super) fn gather(
        &self,
        t: usize,
        rows: std::ops::Range<usize>,
        (src, size): (&[f32], usize),
        zero: &[f32],
        mut f: impl FnMut(usize, *const f32),
    ) {
        let positions = self.to.len();
        let from = &self.from[t * positions..][..positions];
        let (mut sample, mut position) = (rows.start / positions, rows.start % positions);
        let mut base = src[(sample * size).min(src.len())..].as_ptr();
        for i in 0..rows.len() {
            // In bounds: `product` and `outer` check `src` against the samples, and `from` stays inside one.
            f(i, from[position].map_or(zero.as_ptr(), |o| base.wrapping_add(o as usize)));
            position += 1;
            if position == positions {
                (sample, position) = (sample + 1, 0);
                base = src[(sample * size).min(src.len())..].as_ptr();
            }
        }
    }
}

// A sample has fewer than 2^32 numbers: `Geo::check`.
pub(super) fn narrow(x: usize) -> u32 {
    x as u32
}

/// Which input rows every output position reads.
pub(super) fn reach(g: &Geo) -> Class {
    let (oh, ow) = (g.out_h(), g.out_w());
    let mut from = Vec::with_capacity(g.taps() * g.per());
    for tap in 0..g.taps() {
        for oy in 0..oh {
            let y = (oy * g.sh + tap / g.kw).checked_sub(g.ph).filter(|y| *y < g.h);
            for ox in 0..ow {
                let x = (ox * g.sw + tap % g.kw).checked_sub(g.pw).filter(|x| *x < g.w);
                from.push(y.zip(x).map(|(y, x)| narrow((y * g.w + x) * g.c)));
            }
        }
    }
    Class { taps: (0..g.taps()).collect(), from, to: (0..g.per()).map(|p| narrow(p * g.n)).collect() }
}

/// Which rows of the gradient of the output every input position reads: one class for every remainder of the strides.
pub(super) fn reach_back(g: &Geo) -> Vec<Class> {
    let (oh, ow) = (g.out_h(), g.out_w());
    // Output coordinate that tap `k` connects with input coordinate `i`.
    let meets = |i: usize, k: usize, pad: usize, stride: usize, out: usize| {
        (i + pad).checked_sub(k).map(|d| d / stride).filter(|o| *o < out)
    };
    let mut all = Vec::with_capacity(g.sh * g.sw);
    for (ry, rx) in (0..g.sh.min(g.h)).flat_map(|y| (0..g.sw.min(g.w)).map(move |x| (y, x))) {
        let fits = |tap: &usize| {
            let same = |r: usize, pad: usize, k: usize, s: usize| (r + pad) % s == k % s;
            same(ry, g.ph, tap / g.kw, g.sh) && same(rx, g.pw, tap % g.kw, g.sw)
        };
        let taps: Vec<usize> = (0..g.taps()).filter(fits).collect();
        let positions = || (ry..g.h).step_by(g.sh).flat_map(|y| (rx..g.w).step_by(g.sw).map(move |x| (y, x)));
        let mut from = Vec::new();
        for tap in &taps {
            from.extend(positions().map(|(y, x)| {
                let (oy, ox) = (meets(y, tap / g.kw, g.ph, g.sh, oh), meets(x, tap % g.kw, g.pw, g.sw, ow));
                oy.zip(ox).map(|(y, x)| narrow((y * ow + x) * g.n))
            }));
        }
        all.push(Class { taps, from, to: positions().map(|(y, x)| narrow((y * g.w + x) * g.c)).collect() });
    }
    all
}

use crate::builder::Builder;
use crate::layers::{
    Act, Conv1d, ConvTranspose1d, Extra, GroupNorm, Linear, concat, mish, sinusoidal_embedding,
};
use crate::tape::{Node, Tape, run};
use crate::{Error, Result};
use candle_core::Tensor;

/// Sizes of a [`ConditionalUnet1d`].
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnetConfig {
    /// Numbers in an action, D.
    pub input_dim: usize,
    /// Channels of each level, the finest first. The length must be divisible by 2 at every level but the last.
    pub down_dims: Vec<usize>,
    /// Taps of the convolutions, odd. Diffusion Policy: 5.
    pub kernel_size: usize,
    /// Groups of the normalisations; divides every level's channels. Diffusion Policy: 8.
    pub n_groups: usize,
    /// Width of the embedding of the diffusion step, even. LeRobot: 128.
    pub step_embed_dim: usize,
    /// Numbers in the condition, C.
    pub cond_dim: usize,
}

/// Largest width that is taken for one: products of sizes stay far below what a number holds.
const WIDEST: usize = 1 << 20;
/// Most levels.
const DEEPEST: usize = 16;
/// Largest condition.
const CONDITION: usize = 1 << 30;

impl UnetConfig {
    /// # Errors
    /// [`Error::Config`] names the first setting that does not work: more than 16 levels, a kernel beyond 1023, a width beyond
    /// 2^20 and a condition beyond 2^30 do not either.
    pub fn validate(&self) -> Result<()> {
        let fail = |what, expected, found: String| Err(Error::Config { what, expected, found });
        if self.input_dim == 0 || self.input_dim > WIDEST {
            return fail("input_dim", "1 to 1048576", self.input_dim.to_string());
        }
        let dims = &self.down_dims;
        if dims.is_empty() || dims.len() > DEEPEST || dims.iter().any(|d| *d == 0 || *d > WIDEST) {
            return fail("down_dims", "1 to 16 sizes of 1 to 1048576", format!("{dims:?}"));
        }
        if self.n_groups == 0 || self.down_dims.iter().any(|d| !d.is_multiple_of(self.n_groups)) {
            let found = format!("{} for {:?}", self.n_groups, self.down_dims);
            return fail("n_groups", "a divisor of every entry of down_dims", found);
        }
        if self.kernel_size.is_multiple_of(2) || self.kernel_size > 1023 {
            return fail("kernel_size", "an odd number up to 1023", self.kernel_size.to_string());
        }
        let embed = self.step_embed_dim;
        if !(4..=WIDEST).contains(&embed) || embed % 2 == 1 {
            return fail("step_embed_dim", "an even number, 4 to 1048576", embed.to_string());
        }
        if self.cond_dim > CONDITION {
            return fail("cond_dim", "at most 1073741824", self.cond_dim.to_string());
        }
        Ok(())
    }

    /// What the length of a sequence must be a multiple of.
    #[must_use]
    pub fn length_multiple(&self) -> usize {
        1 << self.down_dims.len().saturating_sub(1)
    }
}

/// Convolution, group norm, Mish, and what follows them.
#[derive(Clone, Debug)]
struct ConvBlock {
    conv: Conv1d,
    norm: GroupNorm,
}

impl ConvBlock {
    fn new(from: usize, to: usize, c: &UnetConfig, builder: &Builder<'_>) -> Result<Self> {
        let b = builder.pp("block");
        let conv = Conv1d::new(from, to, c.kernel_size, 1, c.kernel_size / 2, &b.pp(0))?;
        Ok(Self { conv, norm: GroupNorm::new(c.n_groups, to, Act::Mish, &b.pp(1))? })
    }

    fn record(&self, tape: &mut Tape, x: Node, extra: Extra) -> Result<Node> {
        let h = self.conv.record(tape, x)?;
        let y = self.norm.record(tape, h, extra)?;
        tape.done(h);
        Ok(y)
    }
}

/// Two convolution blocks, the first scaled and shifted by the condition, and a residual connection.
#[derive(Clone, Debug)]
struct ResidualBlock {
    first: ConvBlock,
    cond: Linear,
    second: ConvBlock,
    residual: Option<Conv1d>,
}

impl ResidualBlock {
    fn new(from: usize, to: usize, c: &UnetConfig, builder: &Builder<'_>) -> Result<Self> {
        let cond_dim = c.step_embed_dim + c.cond_dim;
        Ok(Self {
            first: ConvBlock::new(from, to, c, &builder.pp("conv1"))?,
            // Index 0 of the reference is the Mish, here taken once for all blocks.
            cond: Linear::new(cond_dim, 2 * to, &builder.pp("cond_encoder").pp(1))?,
            second: ConvBlock::new(to, to, c, &builder.pp("conv2"))?,
            residual: (from != to)
                .then(|| Conv1d::new(from, to, 1, 1, 0, &builder.pp("residual_conv")))
                .transpose()?,
        })
    }

    /// `cond` is Mish of the condition.
    fn record(&self, tape: &mut Tape, x: Node, cond: Node) -> Result<Node> {
        let film = self.cond.record(tape, cond)?;
        let h = self.first.record(tape, x, Extra::Film(film))?;
        tape.done(film);
        let r = match &self.residual {
            Some(conv) => conv.record(tape, x)?,
            None => x,
        };
        let y = self.second.record(tape, h, Extra::After(r))?;
        tape.done(h);
        Ok(y)
    }
}

/// The noise-prediction network of Diffusion Policy: a U-Net over time, each block conditioned on the diffusion step and
/// on the observation.
///
/// Parameters have LeRobot's names below `diffusion.unet.`.
///
/// # Source
/// Chi et al., "Diffusion Policy", section IV.A; `DiffusionConditionalUnet1d` of LeRobot 0.4.4 (`modeling_diffusion.py`).
#[derive(Clone, Debug)]
pub struct ConditionalUnet1d {
    config: UnetConfig,
    step1: Linear,
    step2: Linear,
    down: Vec<(ResidualBlock, ResidualBlock, Option<Conv1d>)>,
    mid: [ResidualBlock; 2],
    up: Vec<(ResidualBlock, ResidualBlock, ConvTranspose1d)>,
    last: ConvBlock,
    out: Conv1d,
}

impl ConditionalUnet1d {
    /// # Errors
    /// As [`UnetConfig::validate`].
    pub fn new(config: &UnetConfig, builder: &Builder<'_>) -> Result<Self> {
        config.validate()?;
        let (dims, embed) = (&config.down_dims, config.step_embed_dim);
        let steps = builder.pp("diffusion_step_encoder");
        let step1 = Linear::new(embed, 4 * embed, &steps.pp(1))?;
        let step2 = Linear::new(4 * embed, embed, &steps.pp(3))?;
        let block = |from, to, b: &Builder<'_>| ResidualBlock::new(from, to, config, b);
        let mut down = Vec::with_capacity(dims.len());
        let mut from = config.input_dim;
        for (i, to) in dims.iter().enumerate() {
            let b = builder.pp("down_modules").pp(i);
            let halve = i + 1 < dims.len();
            let halve = halve.then(|| Conv1d::new(*to, *to, 3, 2, 1, &b.pp(2))).transpose()?;
            down.push((block(from, *to, &b.pp(0))?, block(*to, *to, &b.pp(1))?, halve));
            from = *to;
        }
        let mid = builder.pp("mid_modules");
        let mid = [block(from, from, &mid.pp(0))?, block(from, from, &mid.pp(1))?];
        let mut up = Vec::with_capacity(dims.len() - 1);
        for (i, to) in dims.iter().rev().skip(1).enumerate() {
            let b = builder.pp("up_modules").pp(i);
            let double = ConvTranspose1d::new(*to, *to, &b.pp(2))?;
            up.push((block(2 * from, *to, &b.pp(0))?, block(*to, *to, &b.pp(1))?, double));
            from = *to;
        }
        let b = builder.pp("final_conv");
        let last = ConvBlock::new(from, from, config, &b.pp(0))?;
        let out = Conv1d::new(from, config.input_dim, 1, 1, 0, &b.pp(1))?;
        Ok(Self { config: config.clone(), step1, step2, down, mid, up, last, out })
    }

    /// The sizes it was built with.
    #[must_use]
    pub fn config(&self) -> &UnetConfig {
        &self.config
    }

    /// The predicted noise (or clean actions) of noisy sequences `x`.
    ///
    /// # Shapes
    /// `x` (B, T, D) with T a multiple of [`UnetConfig::length_multiple`], B `timesteps`, `cond` (B, C), to (B, T, D).
    ///
    /// # Errors
    /// [`Error::Shape`] when a shape does not fit.
    pub fn forward(&self, x: &Tensor, timesteps: &[f32], cond: &Tensor) -> Result<Tensor> {
        let multiple = self.config.length_multiple();
        let b = match x.dims() {
            [b, t, d] if *b > 0 && *t > 0 && t.is_multiple_of(multiple) && *d == self.config.input_dim => *b,
            found => {
                let expected = format!("(B, a multiple of {multiple}, {})", self.config.input_dim);
                return Err(Error::Shape { what: "u-net input", expected, found: found.to_vec() });
            }
        };
        if timesteps.len() != b {
            let found = vec![timesteps.len()];
            return Err(Error::Shape { what: "u-net timesteps", expected: format!("({b})"), found });
        }
        if cond.dims() != [b, self.config.cond_dim] {
            let expected = format!("({b}, {})", self.config.cond_dim);
            return Err(Error::Shape { what: "u-net condition", expected, found: cond.dims().to_vec() });
        }
        let embedded = sinusoidal_embedding(timesteps, self.config.step_embed_dim)?.to_device(x.device())?;
        run(&[x, cond, &embedded], Some(self.step1.anchor()), |tape, n| self.record(tape, n[0], n[1], n[2]))
    }

    fn record(&self, tape: &mut Tape, x: Node, cond: Node, embedded: Node) -> Result<Node> {
        let h = self.step1.record(tape, embedded)?;
        let h = mish(tape, h)?;
        let step = self.step2.record(tape, h)?;
        let cond = if self.config.cond_dim > 0 { concat(tape, &[step, cond])? } else { step };
        let cond = mish(tape, cond)?;
        let mut x = x;
        let mut skips = Vec::with_capacity(self.down.len());
        for (first, second, halve) in &self.down {
            let h = first.record(tape, x, cond)?;
            tape.done(x);
            x = second.record(tape, h, cond)?;
            tape.done(h);
            if let Some(halve) = halve {
                skips.push(x);
                x = halve.record(tape, x)?;
            } else {
                // The last level's output is both the middle's input and the first skip.
                skips.push(x);
            }
        }
        for block in &self.mid {
            x = block.record(tape, x, cond)?;
        }
        for (first, second, double) in &self.up {
            if let Some(skip) = skips.pop() {
                let joined = concat(tape, &[x, skip])?;
                tape.done(x);
                tape.done(skip);
                x = joined;
            }
            let h = first.record(tape, x, cond)?;
            tape.done(x);
            x = second.record(tape, h, cond)?;
            tape.done(h);
            let y = double.record(tape, x)?;
            tape.done(x);
            x = y;
        }
        let h = self.last.record(tape, x, Extra::None)?;
        self.out.record(tape, h)
    }
}

use crate::builder::Builder;
use crate::layers::{Act, Conv2d, Extra, GroupNorm, Linear, MaxPool2d, SpatialSoftmax, add, relu};
use crate::tape::{Node, Tape, run};
use crate::{Error, Result};
use candle_core::Tensor;

/// Largest width that is taken for one, and most stages: products of sizes stay far below what a number holds.
const WIDEST: usize = 1 << 16;
const STAGES: usize = 8;
/// Channels of one group of the normalisations.
const GROUP: usize = 16;

/// Sizes of an [`RgbEncoder`].
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RgbEncoderConfig {
    /// Rows of an image, pixels.
    pub height: usize,
    /// Columns of an image, pixels.
    pub width: usize,
    /// Channels of the first stage, a multiple of 16. ResNet-18: 64.
    pub base_width: usize,
    /// Residual blocks of each stage; every stage after the first halves the map and doubles the channels. ResNet-18:
    /// [2, 2, 2, 2]. Fewer stages keep a finer map for small images; more than 8 are refused.
    pub stage_blocks: Vec<usize>,
    /// Keypoints of the spatial softmax. LeRobot: 32.
    pub keypoints: usize,
    /// Numbers that come out. LeRobot: twice the keypoints.
    pub feature_dim: usize,
}

impl RgbEncoderConfig {
    /// # Errors
    /// [`Error::Config`] names the first setting that does not work.
    pub fn validate(&self) -> Result<()> {
        let fail = |what, expected, found: String| Err(Error::Config { what, expected, found });
        if self.base_width == 0 || !self.base_width.is_multiple_of(GROUP) {
            return fail("base_width", "a positive multiple of 16", self.base_width.to_string());
        }
        if self.base_width > WIDEST {
            return fail("base_width", "at most 65536", self.base_width.to_string());
        }
        let stages = &self.stage_blocks;
        if !(1..=STAGES).contains(&stages.len()) || stages.contains(&0) {
            return fail("stage_blocks", "1 to 8 stages of at least one block", format!("{stages:?}"));
        }
        let numbers = [self.keypoints, self.feature_dim];
        if numbers.iter().any(|n| !(1..=WIDEST).contains(n)) {
            return fail("keypoints and feature_dim", "1 to 65536", format!("{numbers:?}"));
        }
        if self.height == 0 || self.width == 0 {
            return fail(
                "height and width",
                "positive numbers",
                format!("{} and {}", self.height, self.width),
            );
        }
        Ok(())
    }

    /// Rows and columns of the map that the spatial softmax sees.
    #[must_use]
    pub fn map_size(&self) -> (usize, usize) {
        // The stem halves twice; every halving rounds up.
        let halvings = self.stage_blocks.len() + 1;
        let small = |n: usize| (0..halvings).fold(n, |n, _| n.div_ceil(2));
        (small(self.height), small(self.width))
    }
}

/// What follows a convolution: group norm, or nothing where a norm is folded into the convolution; then `act`.
#[derive(Clone, Debug)]
struct After {
    norm: Option<GroupNorm>,
    act: Act,
}

impl After {
    fn new(channels: usize, act: Act, folded: bool, builder: &Builder<'_>) -> Result<Self> {
        let norm = || GroupNorm::new(channels / GROUP, channels, act, builder);
        Ok(Self { norm: if folded { None } else { Some(norm()?) }, act })
    }

    /// act(norm(h) + residual); `h` and the residual are not read again.
    fn record(&self, tape: &mut Tape, h: Node, residual: Option<Node>) -> Result<Node> {
        if let Some(norm) = &self.norm {
            let y = norm.record(tape, h, residual.map_or(Extra::None, Extra::Before))?;
            tape.done(h);
            residual.into_iter().for_each(|r| tape.done(r));
            return Ok(y);
        }
        let mut y = h;
        if let Some(r) = residual {
            y = add(tape, h, r)?;
            tape.done(h);
            tape.done(r);
        }
        if self.act == Act::Relu {
            let z = y;
            y = relu(tape, z)?;
            tape.done(z);
        }
        Ok(y)
    }
}

/// Two 3x3 convolutions and a residual connection.
#[derive(Clone, Debug)]
struct BasicBlock {
    conv1: Conv2d,
    after1: After,
    conv2: Conv2d,
    after2: After,
    shortcut: Option<(Conv2d, After)>,
}

impl BasicBlock {
    fn new(channels: (usize, usize), stride: usize, folded: bool, b: &Builder<'_>) -> Result<Self> {
        let (from, to) = channels;
        let conv1 = Conv2d::new((from, to), 3, stride, 1, folded, &b.pp("conv1"))?;
        let after1 = After::new(to, Act::Relu, folded, &b.pp("bn1"))?;
        let conv2 = Conv2d::new((to, to), 3, 1, 1, folded, &b.pp("conv2"))?;
        let after2 = After::new(to, Act::Relu, folded, &b.pp("bn2"))?;
        let shortcut = if stride == 1 && from == to {
            None
        } else {
            let b = b.pp("downsample");
            let conv = Conv2d::new((from, to), 1, stride, 0, folded, &b.pp(0))?;
            Some((conv, After::new(to, Act::None, folded, &b.pp(1))?))
        };
        Ok(Self { conv1, after1, conv2, after2, shortcut })
    }

    fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let h = self.conv1.record(tape, x)?;
        let a = self.after1.record(tape, h, None)?;
        let h = self.conv2.record(tape, a)?;
        tape.done(a);
        let residual = match &self.shortcut {
            None => x,
            Some((conv, after)) => {
                let r = conv.record(tape, x)?;
                after.record(tape, r, None)?
            }
        };
        self.after2.record(tape, h, Some(residual))
    }
}

/// A ResNet with group norm, a spatial softmax and a linear layer: images to features.
///
/// Parameters have LeRobot's names below `diffusion.rgb_encoder.`; its buffer `pool.pos_grid` is no parameter here
/// ([`SpatialSoftmax::position_grid`] makes it).
///
/// # Source
/// `DiffusionRgbEncoder` of LeRobot 0.4.4 (`modeling_diffusion.py`) over torchvision's ResNet-18 with every batch norm
/// replaced by group norm in groups of 16 channels; Chi et al., "Diffusion Policy", section IV.A.
#[derive(Clone, Debug)]
pub struct RgbEncoder {
    config: RgbEncoderConfig,
    stem: Conv2d,
    after_stem: After,
    blocks: Vec<BasicBlock>,
    pool: SpatialSoftmax,
    out: Linear,
}

impl RgbEncoder {
    /// # Errors
    /// As [`RgbEncoderConfig::validate`].
    pub fn new(config: &RgbEncoderConfig, builder: &Builder<'_>) -> Result<Self> {
        Self::with(config, false, builder)
    }

    /// The same without normalisations: every convolution has a bias. With its numbers frozen, a batch norm after a
    /// convolution is a scale and a shift of each channel, which its weights and this bias take over.
    ///
    /// # Errors
    /// As [`RgbEncoderConfig::validate`].
    ///
    /// # Source
    /// Ioffe and Szegedy, "Batch Normalization", algorithm 2, line 11.
    pub fn folded(config: &RgbEncoderConfig, builder: &Builder<'_>) -> Result<Self> {
        Self::with(config, true, builder)
    }

    fn with(config: &RgbEncoderConfig, folded: bool, builder: &Builder<'_>) -> Result<Self> {
        config.validate()?;
        let backbone = builder.pp("backbone");
        let mut width = config.base_width;
        let stem = Conv2d::new((3, width), 7, 2, 3, folded, &backbone.pp(0))?;
        let after_stem = After::new(width, Act::Relu, folded, &backbone.pp(1))?;
        let mut blocks = Vec::new();
        for (stage, count) in config.stage_blocks.iter().enumerate() {
            // Indices 2 and 3 of torchvision's list are the activation and the pooling.
            let b = backbone.pp(4 + stage);
            let to = config.base_width << stage;
            for i in 0..*count {
                let stride = if stage > 0 && i == 0 { 2 } else { 1 };
                blocks.push(BasicBlock::new((width, to), stride, folded, &b.pp(i))?);
                width = to;
            }
        }
        let pool = SpatialSoftmax::new(width, config.keypoints, &builder.pp("pool"))?;
        let out = Linear::new(2 * config.keypoints, config.feature_dim, &builder.pp("out"))?;
        Ok(Self { config: config.clone(), stem, after_stem, blocks, pool, out })
    }

    /// The sizes it was built with.
    #[must_use]
    pub fn config(&self) -> &RgbEncoderConfig {
        &self.config
    }

    /// Features of images. Another size than the configured one works too: the position grid follows the map.
    ///
    /// # Shapes
    /// `(N, H, W, 3)`, channels last, in [0, 1], to `(N, feature_dim)`. The images get no gradient unless Candle tracks
    /// them.
    ///
    /// # Errors
    /// [`Error::Shape`] when the input is no batch of images.
    pub fn forward(&self, images: &Tensor) -> Result<Tensor> {
        match images.dims() {
            [n, h, w, 3] if n * h * w > 0 => {}
            found => {
                let expected = "(N, H, W, 3)".into();
                return Err(Error::Shape { what: "images", expected, found: found.to_vec() });
            }
        }
        run(&[images], Some(self.stem.anchor()), |tape, n| self.record(tape, n[0]))
    }

    fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let h = self.stem.record(tape, x)?;
        let a = self.after_stem.record(tape, h, None)?;
        let mut x = MaxPool2d.record(tape, a)?;
        tape.done(a);
        for block in &self.blocks {
            let y = block.record(tape, x)?;
            tape.done(x);
            x = y;
        }
        let points = self.pool.record(tape, x)?;
        let h = self.out.record(tape, points)?;
        relu(tape, h)
    }
}

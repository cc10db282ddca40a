//! Batch norms as part of the convolutions before them.

use e2h_nn::{HostTensor, Weights};

/// Added to the variance, as in PyTorch's `BatchNorm2d`.
const EPS: f64 = 1e-5;
const MEAN: &str = ".running_mean";

/// The convolution whose result the norm `name` takes, by torchvision's names.
fn convolution(name: &str) -> Option<String> {
    let (front, last) = name.rsplit_once('.')?;
    let conv = match last {
        // `backbone.1` and `downsample.1` follow the first entry of their lists.
        "1" => "0".to_owned(),
        last => format!("conv{}", last.strip_prefix("bn")?),
    };
    Some(format!("{front}.{conv}"))
}

/// Scales the weights of every convolution that a batch norm follows, gives it a bias, and takes the norm away: with w' = w g
/// and b' = b - m g, g = gain / sqrt(variance + eps), the convolution alone computes what both did.
///
/// # Errors
/// Says what of a norm is missing or has another size.
pub(super) fn batch_norms(weights: &mut Weights) -> Result<(), String> {
    let norms: Vec<String> = weights.keys().filter_map(|n| n.strip_suffix(MEAN).map(str::to_owned)).collect();
    for norm in norms {
        let conv =
            convolution(&norm).ok_or_else(|| format!("`{norm}`: expected a norm after a convolution"))?;
        let mut take = |of: &str, name: &str| {
            let name = format!("{of}.{name}");
            weights.remove(&name).ok_or_else(|| format!("expected `{name}`, found none"))
        };
        let (gain, bias) = (take(&norm, "weight")?, take(&norm, "bias")?);
        let (mean, variance) = (take(&norm, "running_mean")?, take(&norm, "running_var")?);
        let mut w = take(&conv, "weight")?;
        let n = w.shape.first().copied().unwrap_or(0);
        for (what, t) in
            [("weight", &gain), ("bias", &bias), ("running_mean", &mean), ("running_var", &variance)]
        {
            if t.shape != [n] {
                return Err(format!("`{norm}.{what}`: expected shape [{n}], found {:?}", t.shape));
            }
        }
        if let Some(v) = variance.data.iter().find(|v| **v < 0.0) {
            return Err(format!("`{norm}.running_var`: expected 0 or more, found {v}"));
        }
        let per = w.data.len() / n.max(1);
        let mut shift = Vec::with_capacity(n);
        for (i, row) in w.data.chunks_exact_mut(per.max(1)).enumerate() {
            let g = f64::from(gain.data[i]) / (f64::from(variance.data[i]) + EPS).sqrt();
            row.iter_mut().for_each(|v| *v = (f64::from(*v) * g) as f32);
            shift.push((f64::from(bias.data[i]) - f64::from(mean.data[i]) * g) as f32);
        }
        if let Some(v) = w.data.iter().chain(&shift).find(|v| !v.is_finite()) {
            return Err(format!(
                "`{norm}`: expected a finite scale and shift, found {v} in `{conv}` with it"
            ));
        }
        weights.insert(format!("{conv}.bias"), HostTensor { shape: vec![shift.len()], data: shift });
        weights.insert(format!("{conv}.weight"), w);
    }
    Ok(())
}

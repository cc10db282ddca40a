"""How far LeRobot's image encoder is from the truth in float32, for tests/golden.

    python make_rounding.py OUT_DIR

The encoder of make_golden.py at 72 x 64, in float64 and in float32 (torch, CPU, one thread), for batches of two images; case c has the
images 0.5 s(1020 + c) + 0.5, in float32. `rounding.safetensors` holds of float64: "out.<c>", the output; "grad.<c>", 16 numbers of
every gradient (at i * (n // 16), parameters in their order); "torch.<c>", how far float32 is from them: of the output the norm of
the difference over the norm, of the gradients the median of that over the parameters (without those whose numbers are all zero,
and `pool.nets.bias`, whose gradient is zero but for rounding).
"""
import os
import sys

os.environ["HF_HUB_OFFLINE"] = "1"
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionRgbEncoder
from safetensors.numpy import save_file

CASES, SAMPLES, SIZE = 25, 16, (72, 64)
torch.set_num_threads(1)


def s(k, n):
    i = np.arange(n, dtype=np.int64)
    return np.sin(0.7 * ((i * 7919 + k * 104729) % 10007) + 0.3)


def fill(module):
    for k, (name, p) in enumerate(sorted(module.named_parameters(), key=lambda e: e[0].encode())):
        v = s(k, p.numel())
        if name.endswith(".bias"):
            v = 0.05 * v
        elif p.dim() == 1:
            v = 1 + 0.1 * v
        else:
            v = v * np.sqrt(2.0 / np.prod(p.shape[1:]))
        with torch.no_grad():
            p.copy_(torch.tensor(v.astype(np.float32).reshape(tuple(p.shape))))


def encoder():
    features = {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=(11,)),
                "observation.images.table": PolicyFeature(type=FeatureType.VISUAL, shape=(3, *SIZE))}
    config = DiffusionConfig(
        input_features=features, output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))},
        crop_shape=SIZE, crop_is_random=False, pretrained_backbone_weights=None, use_group_norm=True, device="cpu",
        push_to_hub=False)
    module = DiffusionRgbEncoder(config)
    fill(module)
    return module


def run(case, dtype):
    """The output, and the sampled gradients by name."""
    module = encoder().to(dtype)
    x = torch.tensor((0.5 * s(1020 + case, 2 * 3 * SIZE[0] * SIZE[1]) + 0.5).astype(np.float32).reshape(2, 3, *SIZE))
    y = module(x.to(dtype))
    (y * torch.tensor(s(2000, y.numel()).astype(np.float32).reshape(y.shape)).to(dtype)).sum().backward()
    sample = lambda g: g.reshape(-1)[:: max(g.numel() // SAMPLES, 1)][:SAMPLES].double().numpy()
    order = sorted(module.named_parameters(), key=lambda e: e[0].encode())
    return y.detach().double().numpy(), {name: sample(p.grad) for name, p in order}


def off(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


out = {}
for case in range(CASES):
    (y, grads), (y32, grads32) = run(case, torch.float64), run(case, torch.float32)
    moved = [n for n, g in grads.items() if n != "pool.nets.bias" and g.any()]
    middle = np.median([off(grads32[n], grads[n]) for n in moved])
    out[f"out.{case}"] = y.astype(np.float32)  # rounded once: a thousandth of what is compared
    out[f"grad.{case}"] = np.concatenate(list(grads.values())).astype(np.float32)
    out[f"torch.{case}"] = np.array([off(y32, y), middle])
    print(case, out[f"torch.{case}"])
save_file(out, os.path.join(sys.argv[1], "rounding.safetensors"))

"""Checkpoints that LeRobot 0.4.4 wrote, with what they do, for crates/policy/tests/lerobot.rs.

    python make_lerobot_policies.py OUT_DIR

`state` is small and complete. `image` lacks `model.safetensors` (a ResNet-18 has 45 MB): its parameters are filled by the
formula of README.md, and so are those of `state` before they are saved; `shapes.json` has their names. `batch` is
the same with batch norms, whose buffers are stated at `fill_buffers`. `expected.safetensors` has the noise of every draw
and the actions in the units of the dataset; observations follow from formulas, stated at `observations`.
`image` has `rounding.safetensors` instead, with actions in float64 and in float32, stated at `rounding`.
"""
import json
import math
import os
import shutil
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
import diffusers.schedulers.scheduling_ddpm as ddpm
import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import save_file

torch.set_num_threads(1)


def s(k, n):
    i = np.arange(n, dtype=np.int64)
    return np.sin(0.7 * ((i * 7919 + k * 104729) % 10007) + 0.3)


def tensor(k, *shape):
    return torch.tensor(s(k, int(np.prod(shape))).astype(np.float32).reshape(shape))


def fill(module):
    """Numbered by the names below `diffusion.`, as in the other files."""
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


def fill_buffers(module):
    """Means and variances of batch norms, numbered k = 6000, 6001, ... by name: 0.2 s(k) and 1 + 0.5 s(k)."""
    buffers = sorted((e for e in module.named_buffers() if ".running_" in e[0]), key=lambda e: e[0].encode())
    for k, (name, b) in enumerate(buffers):
        v = s(6000 + k, b.numel())
        b.copy_(torch.tensor((0.2 * v if name.endswith("mean") else 1 + 0.5 * v).astype(np.float32)))


def feature(kind, *shape):
    return PolicyFeature(type=kind, shape=shape)


def observations(config, step):
    """State and environment: s(3000 + step) and s(3100 + step). Images: byte i of camera c is (31 i + 7 c + 13 step) mod 251."""
    out = {}
    for name, f in config.input_features.items():
        if f.type is FeatureType.VISUAL:
            channels, height, width = f.shape
            camera = list(config.image_features).index(name)
            i = np.arange(height * width * channels, dtype=np.int64)
            pixels = ((31 * i + 7 * camera + 13 * step) % 251).reshape(height, width, channels)
            out[name] = torch.tensor(pixels.astype(np.float32) / 255).permute(2, 0, 1)
        else:
            out[name] = tensor((3100 if f.type is FeatureType.ENV else 3000) + step, *f.shape)
    return out


def make(root, config, stats):
    policy = DiffusionPolicy(config).eval()
    fill(policy.diffusion)
    fill_buffers(policy.diffusion)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    policy.save_pretrained(root)
    before.save_pretrained(root)
    after.save_pretrained(root)
    # Opened again: what counts is what the files say.
    policy = DiffusionPolicy.from_pretrained(root)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(root))
    width = config.output_features["action"].shape[0]
    draws = [tensor(4000, 1, config.horizon, width)]

    def fresh(shape, **_):
        draws.append(tensor(4000 + len(draws), *shape))
        return draws[-1]

    ddpm.randn_tensor = fresh
    noise, actions = draws[0], []
    for step in range(config.n_obs_steps):
        batch = before(observations(config, step))
        if step + 1 < config.n_obs_steps:
            # Fills the history; what it would do is not asked for.
            policy._queues["action"].extend([None])
        action = policy.select_action(batch, noise=noise)
    actions.append(after(action))
    while policy._queues["action"]:
        actions.append(after(policy.select_action(batch, noise=noise)))
    actions = torch.cat(actions)
    assert actions.shape == (config.n_action_steps, width), actions.shape
    save_file({"noise": torch.cat(draws).contiguous(), "actions": actions.contiguous()}, root / "expected.safetensors")
    print(root.name, tuple(actions.shape), len(draws), "draws")


CASES = 48


def rounding(root):
    """The actions of case c in the units of the dataset: "float64", to judge by, and "float32", as torch has them.

    Case c has seen the steps c n_obs_steps + 0, 1, ..., and starts from the noise s(4000 + c). In float64 everything is: images
    over 255, statistics, schedule and network; only the weights, states and noise are the float32 numbers of the files.
    """
    def actions(case, dtype):
        torch.set_default_dtype(dtype)
        policy = DiffusionPolicy.from_pretrained(root).to(dtype)
        before, after = make_pre_post_processors(policy.config, pretrained_path=str(root))
        config, scheduler = policy.config, policy.diffusion.noise_scheduler
        if dtype == torch.float64:
            n = config.num_train_timesteps
            bar = lambda t: math.cos((t / n + 0.008) / 1.008 * math.pi / 2) ** 2
            betas = torch.tensor([min(1 - bar(t + 1) / bar(t), 0.999) for t in range(n)])
            table = torch.cumprod(1 - betas, 0)
            assert (table - scheduler.alphas_cumprod).abs().max() < 1e-6
            scheduler.alphas_cumprod = table
            scheduler.final_alpha_cumprod = torch.tensor(1.0)
        noise = tensor(4000 + case, 1, config.horizon, config.output_features["action"].shape[0]).to(dtype)
        for step in range(config.n_obs_steps):
            seen = observations(config, case * config.n_obs_steps + step)
            for name in config.image_features:
                seen[name] = (seen[name] * 255).round().to(dtype) / 255
            seen = before({name: value.to(dtype) for name, value in seen.items()})
            if step + 1 < config.n_obs_steps:
                policy._queues["action"].extend([None])
            action = policy.select_action(seen, noise=noise)
        found = [after(action)]
        while policy._queues["action"]:
            found.append(after(policy.select_action(seen, noise=noise)))
        torch.set_default_dtype(torch.float32)
        assert found[0].dtype == dtype, found[0].dtype
        return torch.cat(found)

    cases = {d: torch.stack([actions(c, getattr(torch, d)) for c in range(CASES)]).double() for d in ("float64", "float32")}
    off = (cases["float32"] - cases["float64"]).flatten(1).norm(dim=1) / cases["float64"].flatten(1).norm(dim=1)
    (root / "expected.safetensors").unlink()
    # Rounded once: a hundredth of what is compared.
    save_file({name: actions.float() for name, actions in cases.items()}, root / "rounding.safetensors")
    print(root.name, "float32 is off by", off.sort().values.tolist())


out = Path(sys.argv[1])
common = dict(n_obs_steps=2, horizon=8, n_action_steps=5, device="cpu", push_to_hub=False, diffusion_step_embed_dim=8)

# A low-dimensional policy with LeRobot's own sampler.
config = DiffusionConfig(
    input_features={"observation.state": feature(FeatureType.STATE, 5), "observation.environment_state": feature(FeatureType.ENV, 3)},
    output_features={"action": feature(FeatureType.ACTION, 4)}, down_dims=(8, 16), kernel_size=3,
    num_inference_steps=10, normalization_mapping={
        "STATE": NormalizationMode.MEAN_STD, "ENV": NormalizationMode.MIN_MAX, "ACTION": NormalizationMode.MIN_MAX},
    **common,
)
make(out / "state", config, {
    "observation.state": {"mean": tensor(5000, 5), "std": 1.5 + tensor(5001, 5)},
    "observation.environment_state": {"min": -1 - tensor(5002, 3).abs(), "max": 1 + tensor(5003, 3).abs()},
    # The last entry never moves.
    "action": {"min": torch.tensor([-0.3, 0.1, -2.0, 0.25]), "max": torch.tensor([0.4, 0.7, 3.0, 0.25])},
})

# Two cameras, an encoder each, images that are no squares and are cropped by an odd number of pixels.
config = DiffusionConfig(
    input_features={"observation.state": feature(FeatureType.STATE, 6),
                    "observation.images.wrist": feature(FeatureType.VISUAL, 3, 67, 90),
                    "observation.images.front": feature(FeatureType.VISUAL, 3, 67, 90)},
    output_features={"action": feature(FeatureType.ACTION, 3)}, down_dims=(16, 32, 64), kernel_size=5,
    crop_shape=(64, 85), spatial_softmax_num_keypoints=8, use_separate_rgb_encoder_per_camera=True,
    noise_scheduler_type="DDIM", num_inference_steps=8, prediction_type="epsilon", **common,
)
imagenet = {"mean": torch.tensor([0.485, 0.456, 0.406]).reshape(3, 1, 1), "std": torch.tensor([0.229, 0.224, 0.225]).reshape(3, 1, 1)}
make(out / "image", config, {
    "observation.state": {"min": -1.5 + tensor(5004, 6).abs(), "max": 1 + tensor(5005, 6).abs()},
    "observation.images.wrist": imagenet,
    "observation.images.front": {"mean": imagenet["mean"] * 0.9, "std": imagenet["std"] * 1.1},
    "action": {"min": torch.tensor([-0.3, 0.1, -2.0]), "max": torch.tensor([0.4, 0.7, 3.0])},
})
rounding(out / "image")
# Batch norm, the default of LeRobot 0.6, and one encoder.
config = DiffusionConfig(
    input_features={"observation.state": feature(FeatureType.STATE, 2),
                    "observation.images.top": feature(FeatureType.VISUAL, 3, 48, 61)},
    output_features={"action": feature(FeatureType.ACTION, 2)}, down_dims=(16, 32), kernel_size=3,
    crop_shape=(44, 60), spatial_softmax_num_keypoints=8, use_group_norm=False,
    noise_scheduler_type="DDIM", num_inference_steps=4, **common,
)
make(out / "batch", config, {
    "observation.state": {"min": -1.5 + tensor(5006, 2).abs(), "max": 1 + tensor(5007, 2).abs()},
    "observation.images.top": imagenet,
    "action": {"min": torch.tensor([-0.3, -2.0]), "max": torch.tensor([0.4, 3.0])},
})
from safetensors import safe_open  # noqa: E402

for folder in ("image", "batch"):
    with safe_open(out / folder / "model.safetensors", "pt") as file:
        shapes = {name: file.get_slice(name).get_shape() for name in sorted(file.keys())}
    (out / folder / "shapes.json").write_text(json.dumps(shapes, indent=0, separators=(",", ":")) + "\n")
    (out / folder / "model.safetensors").unlink()
for folder in ("state", "image", "batch"):
    shutil.rmtree(out / folder / ".cache", ignore_errors=True)

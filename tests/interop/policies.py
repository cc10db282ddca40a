"""LeRobot's side of the checkpoint checks: opens policies that Rust wrote, writes policies for Rust to open, and compares what
they do with the same observations and the same noise.

Run by run.sh; each command prints one line when it holds and fails with a message when it does not.
"""

import contextlib
import io
import subprocess
import sys
from pathlib import Path

import diffusers.schedulers.scheduling_ddpm as ddpm
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file

LIMIT = 1e-4


def open_policy(root):
    """Every tensor has to be there, and no other; LeRobot says on standard output where it reads."""
    with contextlib.redirect_stdout(io.StringIO()):
        return DiffusionPolicy.from_pretrained(root, strict=True)


def draw(config, root, seed):
    """Observations and every draw of noise: states a little beyond their ranges (To, S), 8-bit images (To, cameras, H, W, 3),
    noise (draws, T, A)."""
    rng = np.random.default_rng(seed)
    steps, width = config.n_obs_steps, config.action_feature.shape[0]
    count = (config.num_inference_steps or config.num_train_timesteps) if config.noise_scheduler_type == "DDPM" else 1
    stats = load_file(Path(root) / "policy_preprocessor_step_3_normalizer_processor.safetensors")
    low, high = (stats[f"observation.state.{end}"].double().numpy() for end in ("min", "max"))
    inputs = {
        "state": low + (high - low) * rng.uniform(-0.3, 1.3, (steps, len(low))),
        "noise": rng.normal(size=(count, config.horizon, width)),
    }
    if config.env_state_feature:
        inputs["environment"] = rng.uniform(-1, 1, (steps, *config.env_state_feature.shape))
    if config.image_features:
        channels, height, wide = next(iter(config.image_features.values())).shape
        # Smooth pictures with some noise, as cameras see them.
        y, x = np.mgrid[0:height, 0:wide]
        shape = (steps, len(config.image_features), height, wide, channels)
        waves = np.stack([127 + 90 * np.sin(0.07 * (i + 1) * x + 0.05 * y + i) for i in range(np.prod(shape[:2]) * channels)])
        waves = waves.reshape(steps, -1, channels, height, wide).transpose(0, 1, 3, 4, 2)
        inputs["images"] = np.clip(waves + rng.normal(0, 12, shape), 0, 255).astype(np.uint8)
    return {k: torch.tensor(np.ascontiguousarray(v.astype(np.float32))) for k, v in inputs.items()}


def act(root, inputs):
    """What LeRobot does, in the units of the dataset: its pre-processor, its policy, its post-processor, action by action."""
    policy = open_policy(root)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(root))
    draws = iter(inputs["noise"][1:])
    ddpm.randn_tensor = lambda shape, **_: next(draws).reshape(shape)
    noise, actions = inputs["noise"][:1], []
    for step in range(policy.config.n_obs_steps):
        observation = {"observation.state": inputs["state"][step]}
        if "environment" in inputs:
            observation["observation.environment_state"] = inputs["environment"][step]
        for camera, name in enumerate(policy.config.image_features):
            observation[name] = inputs["images"][step, camera].permute(2, 0, 1) / 255
        batch = before(observation)
        if step + 1 < policy.config.n_obs_steps:
            # Takes the place of an action that is not asked for while the history fills.
            policy._queues["action"].append(None)
        action = policy.select_action(batch, noise=noise)
    actions.append(after(action))
    while policy._queues["action"]:
        actions.append(after(policy.select_action(batch, noise=noise)))
    assert len(actions) == policy.config.n_action_steps
    return policy, torch.cat(actions)


def rust(program, how, folder, inputs, work):
    save_file(inputs, work / "inputs.safetensors")
    subprocess.run([program, how, folder, work / "inputs.safetensors", work / "actions.safetensors"], check=True)
    return load_file(work / "actions.safetensors")["actions"]


def same(what, a, b):
    assert a.shape == b.shape, (what, a.shape, b.shape)
    worst = (a - b).abs().max().item()
    assert worst < LIMIT, (what, worst)
    return worst


def ours(program, checkpoint, published):
    """A policy of ours, exported: LeRobot opens it strictly and acts as we do."""
    work = Path(published).parent
    config = open_policy(published).config
    worst = 0.0
    for seed in range(3):
        inputs = draw(config, published, seed)
        policy, actions = act(published, inputs)
        worst = max(worst, same("checkpoint", rust(program, "ours", checkpoint, inputs, work), actions))
        # The published folder is one of ours as well, and one of LeRobot's.
        for how in ("ours", "theirs"):
            worst = max(worst, same(how, rust(program, how, published, inputs, work), actions))
    span = (actions.max(0).values - actions.min(0).values).max().item()
    print(f"LeRobot opened {sum(p.numel() for p in policy.parameters())} parameters and acted the same: "
          f"difference {worst:.1e} at most, actions span {span:.2f}")


def trained(program, root):
    """A policy that `train` made of a dataset of any robot: LeRobot opens it strictly and acts as we do."""
    work = Path(root).parent
    config = open_policy(root).config
    worst = 0.0
    for seed in range(3):
        inputs = draw(config, root, seed)
        policy, actions = act(root, inputs)
        worst = max(worst, same("trained", rust(program, "theirs", root, inputs, work), actions))
    span = (actions.max(0).values - actions.min(0).values).max().item()
    print(f"LeRobot opened {sum(p.numel() for p in policy.parameters())} parameters, {len(inputs['state'][0])} numbers of state, "
          f"{actions.shape[1]} of action, and acted the same: difference {worst:.1e} at most, actions span {span:.2f}")


def feature(kind, *shape):
    return PolicyFeature(type=kind, shape=shape)


def theirs(program, export, work):
    """Policies that LeRobot wrote act the same when Rust opens them; one with our widths becomes a checkpoint of ours."""
    work = Path(work)
    state, action = feature(FeatureType.STATE, 15), feature(FeatureType.ACTION, 8)
    image = feature(FeatureType.VISUAL, 3, 96, 96)
    small = dict(down_dims=(32, 64, 128), diffusion_step_embed_dim=32, device="cpu", push_to_hub=False)
    cameras = {"observation.images.wrist": image, "observation.images.front": image}
    policies = {
        # LeRobot's own defaults but for the sizes: DDPM with 100 steps, one encoder, ImageNet statistics.
        "defaults": DiffusionConfig(input_features={"observation.state": state, **cameras},
                                    output_features={"action": action}, crop_shape=(84, 84), **small),
        "ddim": DiffusionConfig(input_features={"observation.state": state, **cameras}, output_features={"action": action},
                                noise_scheduler_type="DDIM", num_inference_steps=10, crop_shape=(88, 88),
                                use_separate_rgb_encoder_per_camera=True, **small),
        "another robot": DiffusionConfig(
            input_features={"observation.state": feature(FeatureType.STATE, 6), "observation.image": feature(FeatureType.VISUAL, 3, 120, 160)},
            output_features={"action": feature(FeatureType.ACTION, 6)}, vision_backbone="resnet34", prediction_type="sample",
            noise_scheduler_type="DDIM", num_inference_steps=16, **small),
    }
    for seed, (name, config) in enumerate(policies.items()):
        torch.manual_seed(seed)
        root = work / name.replace(" ", "-")
        imagenet = {"mean": torch.tensor([0.485, 0.456, 0.406]).reshape(3, 1, 1), "std": torch.tensor([0.229, 0.224, 0.225]).reshape(3, 1, 1)}
        stats = {k: imagenet for k in config.image_features}
        width = config.action_feature.shape[0]
        stats["observation.state"] = {"min": -torch.ones(config.robot_state_feature.shape), "max": torch.rand(config.robot_state_feature.shape) + 0.5}
        stats["action"] = {"min": -torch.rand(width), "max": torch.rand(width) + 0.5}
        policy = DiffusionPolicy(config)
        before, after = make_pre_post_processors(config, dataset_stats=stats)
        for part in (policy, before, after):
            part.save_pretrained(root)
        inputs = draw(config, root, seed)
        _, actions = act(root, inputs)
        worst = same(name, rust(program, "theirs", root, inputs, work), actions)
        if width == 8:
            checkpoint = work / (root.name + "-ours")
            subprocess.run([export, "--from-lerobot", root, "--out", checkpoint], check=True, stdout=subprocess.DEVNULL)
            worst = max(worst, same(name, rust(program, "ours", checkpoint, inputs, work), actions))
            back = work / (root.name + "-back")
            subprocess.run([export, "--checkpoint", checkpoint, "--lerobot", back], check=True, stdout=subprocess.DEVNULL)
            worst = max(worst, same(name, act(back, inputs)[1], actions))
        print(f"{name}: Rust acted the same, difference {worst:.1e} at most")


if __name__ == "__main__":
    {"ours": ours, "theirs": theirs, "trained": trained}[sys.argv[1]](*sys.argv[2:])

"""What compare_train.sh found: loss curves, the loss on held-out episodes and steps a second of LeRobot's training and ours.

    python validate_train.py FOLDER STEPS SEED...

Both checkpoints are opened and run by LeRobot, on the same windows with the same noise and timesteps.
"""

import json
import re
import statistics
import sys
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors

work, steps, seeds = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
torch.set_num_threads(2)


def held_out(folder):
    """Mean squared error of the predicted noise, over windows that stay within their episode."""
    policy = DiffusionPolicy.from_pretrained(folder, strict=True).eval()
    before, _ = make_pre_post_processors(policy.config, str(folder), preprocessor_overrides={"device_processor": {"device": "cpu"}})
    root = work / "held-out"
    dataset = LeRobotDataset(
        "local/held-out", root=root,
        delta_timestamps=resolve_delta_timestamps(policy.config, LeRobotDatasetMetadata("local/held-out", root=root)),
    )
    rows = [i for i in range(0, len(dataset), 4) if not dataset[i]["action_is_pad"].any()]
    torch.manual_seed(0)
    losses = []
    with torch.no_grad():
        for at in range(0, len(rows), 16):
            batch = torch.utils.data.default_collate([dataset[i] for i in rows[at : at + 16]])
            losses.append(policy.forward(before(batch))[0].item())
    return statistics.mean(losses)


def curve_of_lerobot(seed):
    lines = re.findall(r"loss:([0-9.]+) .*?updt_s:([0-9.]+) data_s:([0-9.]+)", (work / f"lerobot-{seed}.log").read_text())
    return [float(l[0]) for l in lines], statistics.mean(float(l[1]) + float(l[2]) for l in lines)


def curve_of_ours(seed):
    lines = [json.loads(l) for l in (work / f"ours-{seed}" / "metrics.jsonl").read_text().splitlines()]
    curve = [l["loss"] for l in lines if "loss" in l and l["step"] % 100 == 0]
    seconds = re.search(r"seconds ([0-9.]+)", (work / f"ours-{seed}.log").read_text())[1]
    # Of the whole program, reading the dataset and writing the checkpoint included.
    return curve, float(seconds) / steps


def newest(folder):
    return sorted(folder.glob("checkpoints/[0-9]*/pretrained_model"))[-1]


print("mean loss of steps " + ", ".join(f"{i - 99} to {i}" for i in range(100, steps + 1, 100)))
for name, curve_of in (("lerobot", curve_of_lerobot), ("ours", curve_of_ours)):
    rates, losses = [], []
    for seed in seeds:
        curve, seconds = curve_of(seed)
        rates.append(seconds)
        losses.append(held_out(newest(work / f"{name}-{seed}")))
        print(f"{name:8} seed {seed}: " + " ".join(f"{l:.3f}" for l in curve) + f" | held out {losses[-1]:.4f} | {1 / seconds:.2f} steps/s")
    if name == "lerobot":
        theirs = statistics.mean(rates)
print(f"steps a second, ours over LeRobot's: {theirs / statistics.mean(rates):.2f}")

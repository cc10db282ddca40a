"""LeRobot's side of the interop checks: opens, compares, extends and writes datasets, and trains on one.

Run by run.sh; each command prints one line when it holds and fails with a message when it does not.
"""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset

DEFAULTS = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def open_dataset(root):
    # The decoder that comes with the packages; torchcodec, the default, needs FFmpeg's libraries on the machine.
    return LeRobotDataset("local/interop", root=root, video_backend="pyav")


def as_uint8(image):
    """LeRobot hands out images as float32 (C, H, W) in [0, 1]."""
    return (image * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def dump(program, root):
    out = subprocess.run([program, "dump", root], check=True, capture_output=True, text=True).stdout
    return [json.loads(line) for line in out.splitlines()]


def compare(program, root):
    """Every number and every pixel is the same for LeRobot and for the Rust reader."""
    dataset, index, images = open_dataset(root), 0, 0
    episodes = dump(program, root)
    assert len(episodes) == dataset.num_episodes, (len(episodes), dataset.num_episodes)
    for episode in episodes:
        for row in range(episode["rows"]):
            item = dataset[index]
            assert item["task"] == episode["tasks"][row], (index, item["task"], episode["tasks"][row])
            for name, column in episode["columns"].items():
                feature = dataset.features[name]
                if feature["dtype"] in ("image", "video"):
                    found = hashlib.sha256(as_uint8(item[name]).tobytes()).hexdigest()
                    if feature["dtype"] == "image":
                        assert found == column[row], (index, name)
                    images += 1
                    continue
                width = int(np.prod(feature["shape"]))
                expected = np.array(column[row * width : (row + 1) * width])
                found = item[name].numpy().reshape(-1) if hasattr(item[name], "numpy") else np.array([item[name]])
                assert (found == expected.astype(found.dtype)).all(), (index, name, found, expected)
            index += 1
    assert index == len(dataset), (index, len(dataset))
    print(f"same {index} frames of {len(episodes)} episodes, {images} images")


def statistics(root):
    """stats.json and the episodes' statistics are those that LeRobot computes from the same frames."""
    dataset = open_dataset(root)
    features = {k: v for k, v in dataset.features.items() if v["dtype"] not in ("string", "video")}
    per_episode, index, worst = [], 0, {}
    squares = {}
    scratch = Path(root).parent / "frames"
    scratch.mkdir(exist_ok=True)
    for length in dataset.meta.episodes["length"]:
        data = {name: [] for name in features}
        for row in range(length):
            item = dataset[index + row]
            for name, feature in features.items():
                if feature["dtype"] == "image":
                    from PIL import Image

                    path = scratch / f"{name}-{row}.png"
                    Image.fromarray(as_uint8(item[name])).save(path, compress_level=1)
                    data[name].append(str(path))
                else:
                    value = item[name].numpy() if hasattr(item[name], "numpy") else np.array(item[name])
                    data[name].append(value.reshape(feature["shape"]))
        # In 64 bits: LeRobot sums in the type of the column, which the frames do not ask for.
        arrays = {
            name: value if features[name]["dtype"] == "image"
            else np.stack(value).astype(np.float64 if np.issubdtype(value[0].dtype, np.floating) else value[0].dtype)
            for name, value in data.items()
        }
        stats = compute_episode_stats(arrays, features)
        for name, feature in features.items():
            if feature["dtype"] == "image":
                # LeRobot 0.4.4 squares 8-bit pixels in 8 bits: its deviation of an image is wrong. Ours is compared to numpy.
                stats[name]["std"] = image_std(data[name])
            if name == "source.seed":
                # The squares of 64-bit seeds overflow there.
                stats[name]["std"] = np.zeros_like(stats[name]["std"], dtype=float)
        per_episode.append(stats)
        index += length
    expected = aggregate_stats([per_episode[0], per_episode[1]]) if len(per_episode) > 1 else per_episode[0]
    for stats in per_episode[2:]:
        expected = aggregate_stats([expected, stats])
    found = json.load(open(Path(root) / "meta/stats.json"))
    assert set(found) == set(expected), set(found) ^ set(expected)
    for name, stats in expected.items():
        assert set(found[name]) == set(stats), (name, set(found[name]) ^ set(stats))
        scale = max(1e-6, float(np.max(np.abs(np.stack([stats["min"], stats["max"]]).astype(float)))))
        for key, value in stats.items():
            ours, theirs = np.array(found[name][key]), np.array(value)
            assert ours.shape == theirs.shape, (name, key, ours.shape, theirs.shape)
            if key in ("min", "max"):
                assert ours.dtype.kind == theirs.dtype.kind, (name, key, ours.dtype, theirs.dtype)
            error = float(np.max(np.abs(ours.astype(float) - theirs.astype(float)))) / scale
            # A quantile is exact to a bin of the histogram, a 5000th of the range, which is at most twice the scale.
            limit = 5e-4 if key.startswith("q") else 1e-6
            assert error <= limit, (name, key, error, found[name][key], np.array(value).tolist())
            worst[key[0]] = max(worst.get(key[0], 0), error)
    print(f"same statistics of {len(expected)} features; largest relative difference "
          f"{max(v for k, v in worst.items() if k != 'q'):.1e}, of quantiles {worst['q']:.1e}")


def image_std(paths):
    from lerobot.datasets.compute_stats import sample_images

    pixels = sample_images(paths).astype(np.float64)
    return (pixels.std(axis=(0, 2, 3)) / 255.0).reshape(3, 1, 1)


def append(root):
    """LeRobot records one more episode into a dataset that Rust wrote."""
    dataset = open_dataset(root)
    before, rng = dataset.num_episodes, np.random.default_rng(0)
    for _ in range(9):
        frame = {"task": "something new"}
        for name, feature in dataset.features.items():
            if name in DEFAULTS:
                continue
            shape, dtype = tuple(feature["shape"]), feature["dtype"]
            if dtype == "image":
                frame[name] = rng.integers(0, 255, shape, dtype=np.uint8)
            else:
                frame[name] = rng.integers(0, 2, shape).astype(dtype)
        dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()
    after = open_dataset(root)
    assert after.num_episodes == before + 1 and after[len(after) - 1]["task"] == "something new"
    print(f"LeRobot appended: {after.num_episodes} episodes, {len(after)} frames")


def windows(root):
    """LeRobot's sampler makes training batches of a dataset that Rust wrote."""
    fps = open_dataset(root).fps
    keys = {"observation.state": [-1 / fps, 0.0], "action": [i / fps for i in range(-1, 15)]}
    dataset = LeRobotDataset("local/interop", root=root, delta_timestamps=keys)
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)))
    assert batch["action"].shape[:2] == (4, 16) and batch["observation.state"].shape[:2] == (4, 2)
    print("batches", {k: tuple(v.shape) for k, v in batch.items() if k.startswith(("obs", "act"))})


def foreign(root, video):
    """A recording of another robot, by LeRobot alone: 30 Hz, other names, xyzw quaternions, a gripper in millimetres.

    The arm pulls a plug out of a socket along z, pauses, carries it aside, and lets go.
    """
    image = {"dtype": "video" if video else "image", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
    features = {
        "observation.state": {"dtype": "float32", "shape": (6,), "names": [f"joint_{i}" for i in range(6)]},
        "observation.tcp": {"dtype": "float32", "shape": (7,), "names": ["x", "y", "z", "qx", "qy", "qz", "qw"]},
        "observation.jaw_mm": {"dtype": "float32", "shape": (1,), "names": None},
        "observation.images.front": image,
        "action": {"dtype": "float32", "shape": (6,), "names": [f"joint_{i}" for i in range(6)]},
    }
    dataset = LeRobotDataset.create(
        "local/foreign", fps=30, features=features, root=root, robot_type="other_arm", use_videos=video
    )
    rng = np.random.default_rng(3)
    for episode in range(3):
        # Positions in m at 30 Hz: up, a pause, aside, a slow stretch, then the jaw opens and the hand rises.
        speed = 0.12 + 0.02 * episode
        steps = [(0, 0, speed)] * 25 + [(0, 0, 0)] * 40 + [(0, speed, 0)] * 30 + [(0, 0.05, 0)] * 24
        steps += [(0, 0, 0)] * 20 + [(0, 0, speed)] * 20
        position = np.array([0.4, 0.1 * episode, 0.2])
        for t, step in enumerate(steps):
            jaw = 22.0 if t < 125 else min(80.0, 22.0 + 12.0 * (t - 125))
            joints = np.concatenate([position, [jaw / 80, t / len(steps), episode]]).astype("f4")
            frame = np.full((48, 64, 3), 40 + episode, np.uint8)
            x, y = 8 + int(position[1] * 60) % 48, 40 - int((position[2] - 0.2) * 100) % 36
            frame[max(0, y - 3) : y + 3, x : x + 6] = (200, 30 + t % 200, 20)
            angle = 0.3 * t / len(steps)
            dataset.add_frame({
                "observation.state": joints,
                "observation.tcp": np.array([*position, 1.0 * np.cos(angle / 2), 1.0 * np.sin(angle / 2), 0, 0], "f4"),
                "observation.jaw_mm": np.array([jaw], "f4"),
                "observation.images.front": frame,
                "action": joints + rng.normal(0, 1e-3, 6).astype("f4"),
                "task": "unplug",
            })
            position = position + np.array(step) / 30
        dataset.save_episode()
    dataset.finalize()
    print(f"LeRobot wrote {dataset.num_episodes} episodes, {dataset.num_frames} frames at 30 Hz"
          + (" with a video" if video else ""))


def refined(source, root):
    """What the refine example wrote follows from the recording: images, joints and poses of the rows it names, backwards."""
    recording, result = open_dataset(source), open_dataset(root)
    starts = recording.meta.episodes["dataset_from_index"]
    backwards = 0
    for i in range(len(result)):
        item = result[i]
        row = starts[int(item["source.episode"])] + int(item["source.frame"])
        original = recording[row]
        assert torch.equal(item["observation.images.front"], original["observation.images.front"]), i
        state, joints = item["observation.state"], original["observation.state"]
        assert torch.equal(state[8:], joints), (i, state[8:], joints)
        # Poses lie between rows: at most half a row of the fastest motion, 5 mm at 30 Hz, and what re-timing moves.
        assert (state[:3] - original["observation.tcp"][:3]).norm() < 0.006, i
        assert abs(state[7] - original["observation.jaw_mm"] / 1000) < 0.008, i
        quaternion = original["observation.tcp"][[6, 3, 4, 5]]
        assert abs(abs(state[3:7] @ quaternion) - 1) < 1e-3, i
        assert item["source.reversed"] and item["task"] == "plug it in"
        last = i + 1 == len(result) or int(result[i + 1]["frame_index"]) == 0
        assert bool(item["next.success"]) == last
        if not last:
            following = result[i + 1]
            backwards += int(following["source.frame"]) < int(item["source.frame"])
            assert torch.allclose(item["action"][:7], following["observation.state"][:7], atol=1e-5), i
            assert item["action"][7] in (0.0, 1.0)
    episodes = result.num_episodes
    assert backwards == len(result) - episodes, (backwards, len(result), episodes)
    assert len(result) < len(recording) * 20 / 30, "pauses were cut"
    report = json.load(open(Path(root) / "report/report.json"))
    fates = report["fates"]
    assert fates["frames"] == fates["kept"] + fates["still"] + fates["resampled"], fates
    assert fates["kept"] == len(result) and fates["still"] > 50 and fates["resampled"] > 10, fates
    print(f"{len(recording)} frames at 30 Hz became {len(result)} at 20 Hz, each with the image of its row, backwards")


def video(program, root):
    """Frames of a video are those that LeRobot decodes, to what two decoders' colour conversions differ by."""
    dataset, index, worst = open_dataset(root), 0, 0.0
    for episode in frames(program, root):
        for image in episode:
            difference = np.abs(image.astype(int) - as_uint8(dataset[index]["observation.images.front"]).astype(int))
            worst = max(worst, float(difference.mean()))
            index += 1
    assert index == len(dataset), (index, len(dataset))
    # Two decoders may convert colours a little differently.
    assert worst < 2.0, worst
    print(f"same {index} video frames; mean absolute difference at most {worst:.2f} of 255")


def frames(program, root):
    """PNG files of a dataset's camera, as the Rust reader hands them out."""
    from PIL import Image

    folder = Path(root).parent / "frames-out"
    subprocess.run([program, "images", root, folder], check=True)
    for episode in sorted(folder.iterdir()):
        yield [np.array(Image.open(p).convert("RGB")) for p in sorted(episode.iterdir())]


def train(root):
    """LeRobot trains its diffusion policy on the dataset for a few steps: losses are finite, gradients reach every part."""
    from lerobot.configs.types import FeatureType
    from lerobot.datasets.utils import dataset_to_policy_features
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(0)
    meta = open_dataset(root).meta
    features = dataset_to_policy_features(meta.features)
    outputs = {k: v for k, v in features.items() if v.type is FeatureType.ACTION}
    inputs = {k: v for k, v in features.items() if k not in outputs}
    config = DiffusionConfig(
        input_features=inputs, output_features=outputs, down_dims=(16, 32), diffusion_step_embed_dim=16,
        spatial_softmax_num_keypoints=4, crop_shape=None, device="cpu", push_to_hub=False,
    )
    config.horizon = 8
    config.n_action_steps = 4
    policy = DiffusionPolicy(config).train()
    before, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    times = {k: [i / meta.fps for i in config.observation_delta_indices] for k in inputs}
    times["action"] = [i / meta.fps for i in config.action_delta_indices]
    dataset = LeRobotDataset("local/interop", root=root, delta_timestamps=times)
    loader = iter(torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True))
    optimiser, losses = torch.optim.Adam(policy.parameters(), 1e-3), []
    for _ in range(3):
        loss, _ = policy.forward(before(next(loader)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert all(np.isfinite(losses)), losses
    idle = [n for n, p in policy.named_parameters() if p.grad is None]
    assert not idle, idle
    print(f"LeRobot trained on inputs {sorted(inputs)}: losses {[round(v, 3) for v in losses]}")


def edit(root, out):
    """What LeRobot's own tools make of a dataset: two merged, one episode deleted, one split in two."""
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset

    source, out = LeRobotDataset("local/source", root=root), Path(out)
    out.mkdir()
    merge_datasets([source, source], output_repo_id="local/merged", output_dir=out / "merged")
    delete_episodes(source, [0], output_dir=out / "deleted", repo_id="local/deleted")
    split_dataset(source, {"first": [0], "rest": list(range(1, source.num_episodes))}, output_dir=out / "split")
    # A split is a folder of datasets; run.sh looks at each.
    for part in (out / "split").iterdir():
        part.rename(out / f"split-{part.name}")
    (out / "split").rmdir()
    print("LeRobot made", sorted(p.name for p in out.iterdir()))


COMMANDS = {
    "edit": edit,
    "compare": compare, "statistics": statistics, "append": append, "windows": windows, "train": train,
    "refined": refined, "video": video,
    "foreign": lambda root: foreign(root, False), "foreign-video": lambda root: foreign(root, True),
}
if __name__ == "__main__":
    COMMANDS[sys.argv[1]](*sys.argv[2:])

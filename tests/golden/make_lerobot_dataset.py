"""Two small datasets of another robot that LeRobot 0.4.4 wrote, for the tests that read one.

    python make_lerobot_dataset.py OUT_DIR

`dataset` has its images in Parquet, `video` in a video, with a state and an action besides.

Two episodes of five and four rows at 30 Hz, with names of its own, a matrix, a flag, text, one camera, and no image statistics
that depend on a library's version. Numbers follow from episode e and row t: entry i of a vector is e + t / 8 + i / 64, exact in
32 bits; the pixels of a row are 16 e + t everywhere.
"""
import os
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

ROWS = [5, 4]
IMAGE = ["height", "width", "channels"]
TASKS = ["unplug", "plug it in"]


def main(out, video):
    features = {
        "observation.tcp": {"dtype": "float32", "shape": (7,), "names": ["x", "y", "z", "qx", "qy", "qz", "qw"]},
        "observation.jaw_mm": {"dtype": "float32", "shape": (1,), "names": None},
        "observation.force": {"dtype": "float64", "shape": (2, 3), "names": None},
        "observation.images.front": {"dtype": "image", "shape": (6, 8, 3), "names": IMAGE},
        "action": {"dtype": "float32", "shape": (3,), "names": {"motors": ["pan", "lift", "jaw"]}},
        "touching": {"dtype": "bool", "shape": (1,), "names": None},
        "ticks": {"dtype": "int32", "shape": (1,), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
    }
    height, width = 6, 8
    if video:
        # No encoder takes smaller ones.
        height, width = 64, 96
        camera = {"dtype": "video", "shape": (height, width, 3), "names": IMAGE}
        features = {k: features[k] for k in ("observation.tcp", "action")} | {"observation.images.front": camera}
    dataset = LeRobotDataset.create("local/golden", fps=30, features=features, root=out, robot_type="other_arm", use_videos=video)
    for e, rows in enumerate(ROWS):
        for t in range(rows):
            vector = lambda n, dtype="f4": (e + t / 8 + np.arange(n) / 64).astype(dtype)
            frame = {
                "observation.tcp": vector(7),
                "observation.jaw_mm": vector(1),
                "observation.force": vector(6, "f8").reshape(2, 3),
                "observation.images.front": np.full((height, width, 3), 16 * e + t, np.uint8),
                "action": vector(3),
                "touching": np.array([t % 2 == 1]),
                "ticks": np.array([1000 * e + t], np.int32),
                "note": "first" if t == 0 else "",
                "task": TASKS[e],
            }
            dataset.add_frame({k: v for k, v in frame.items() if k in features or k == "task"})
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    for name in ("dataset", "video"):
        main(Path(sys.argv[1]) / name, name == "video")

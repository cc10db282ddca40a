"""Latency of a LeRobot diffusion policy behind openpi's protocol: the policy, its server in Python, and the clients.

    serve.py make DIR              writes a policy of LeRobot's with drawn weights
    serve.py serve DIR PORT        openpi's own server around LeRobot's torch policy
    serve.py load PORT CLIENTS N   so many clients, each N requests one after the other; prints one JSON line
"""

import json
import multiprocessing
import sys
import time

import numpy as np

STATE, ACTION, SIDE = 15, 8, 72
CAMERAS = ("image", "wrist_image")


def config():
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, SIDE, SIDE))
    return DiffusionConfig(
        input_features={
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(STATE,)),
            **{f"observation.images.{name}": image for name in CAMERAS},
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(ACTION,))},
        crop_shape=(64, 64),
        down_dims=(128, 256, 512),
        noise_scheduler_type="DDIM",
        num_inference_steps=10,
        device="cpu",
        push_to_hub=False,
    )


def make(root):
    import torch
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(0)
    c = config()
    third = torch.full((3, 1, 1), 0.5)
    stats = {name: {"mean": third, "std": third} for name in c.image_features}
    stats["observation.state"] = {"min": -torch.ones(STATE), "max": torch.ones(STATE)}
    stats["action"] = {"min": -torch.ones(ACTION), "max": torch.ones(ACTION)}
    policy = DiffusionPolicy(c)
    before, after = make_pre_post_processors(c, dataset_stats=stats)
    for part in (policy, before, after):
        part.save_pretrained(root)
    print(f"{sum(p.numel() for p in policy.parameters())} parameters")


def serve(root, port):
    import torch
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from openpi.serving.websocket_policy_server import WebsocketPolicyServer

    torch.set_num_threads(1)
    policy = DiffusionPolicy.from_pretrained(root)
    policy.eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(root))
    steps, ahead = policy.config.n_obs_steps, policy.config.n_action_steps

    class Served:
        @torch.inference_mode()
        def infer(self, obs):
            seen = {"observation.state": torch.tensor(obs["observation/state"])}
            for name in CAMERAS:
                image = torch.tensor(obs[f"observation/{name}"]).permute(2, 0, 1) / 255
                seen[f"observation.images.{name}"] = image
            batch = before(seen)
            history = {"observation.state": torch.stack([batch["observation.state"]] * steps, 1)}
            images = torch.stack([batch[f"observation.images.{name}"] for name in CAMERAS], 1)
            history["observation.images"] = torch.stack([images] * steps, 1)
            actions = after(policy.diffusion.generate_actions(history)[:, :ahead])
            return {"actions": actions[0].numpy()}

    WebsocketPolicyServer(Served(), host="127.0.0.1", port=int(port)).serve_forever()


def client(port, seed, count, start, out):
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    policy = WebsocketClientPolicy("127.0.0.1", port)
    random = np.random.default_rng(seed)
    observation = {
        "observation/state": random.uniform(-1, 1, STATE).astype(np.float32),
        **{f"observation/{name}": random.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8) for name in CAMERAS},
    }
    # Openpi's server shakes no hands while it thinks: all are there before the first asks.
    start.wait()
    policy.infer(observation)
    start.wait()
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        answer = policy.infer(observation)
        times.append(time.perf_counter() - begin)
        assert answer["actions"].shape[1] == ACTION
    out.put(times)


def load(port, clients, count):
    start, out = multiprocessing.Barrier(clients + 1), multiprocessing.Queue()
    all_of_them = [multiprocessing.Process(target=client, args=(port, c, count, start, out)) for c in range(clients)]
    for process in all_of_them:
        process.start()
    start.wait()
    start.wait()
    begin = time.perf_counter()
    times = np.sort(np.concatenate([out.get() for _ in all_of_them])) * 1e3
    seconds = time.perf_counter() - begin
    for process in all_of_them:
        process.join()
    print(json.dumps({
        "clients": clients,
        "median_ms": round(float(np.median(times)), 2),
        "p95_ms": round(float(times[int(0.95 * len(times))]), 2),
        "answers_per_second": round(clients * count / seconds, 2),
    }))


if __name__ == "__main__":
    command, *rest = sys.argv[1:]
    if command == "load":
        load(*map(int, rest))
    else:
        {"make": make, "serve": serve}[command](*rest)

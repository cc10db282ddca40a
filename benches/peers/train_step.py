"""The PyTorch side of the training-step and sampling comparison: LeRobot's own U-Net and spatial softmax.

    python train_step.py [--size laptop|paper] [--threads 2] [--repeats 15] [--device cpu|cuda]
                         [--precision f32 tf32 bf16] [--dump FILE]

Needs lerobot==0.4.4 (compare.sh installs it). Prints one JSON line a variant, medians in milliseconds:
  forward       without gradients
  step          forward, backward, clipping at 1, Adam, moving average of the weights
  ddim1, ddim8  encoders and ten DDIM steps, for 1 and 8 observations
  rss_mb        peak resident memory so far
  loss          of the first step
Variants: "default" (NCHW, Adam foreach) and "tuned" (channels last, fused Adam). The peer to beat is the faster of the two, on an
otherwise idle machine with OpenMP's defaults.
--precision, on a GPU: products and convolutions of f32 as they are, on tensor cores (TF32), or under autocast in bf16.
--dump writes the weights, under LeRobot's names, and the data of the first step, for `cargo run --example peer -- --data FILE`.
"""

import argparse
import json
import os
import resource
import statistics
import time

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import torch
import torch.nn.functional as F
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionConditionalUnet1d, SpatialSoftmax
from torch import nn

# size: encoder width, pixels, U-Net channels, batch
SIZES = {"laptop": (16, 64, (64, 128, 256), 32), "paper": (64, 128, (256, 512, 1024), 4)}

parser = argparse.ArgumentParser()
parser.add_argument("--size", choices=SIZES, default="laptop")
parser.add_argument("--batch", type=int)
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--repeats", type=int, default=15)
parser.add_argument("--device", default="cpu")
parser.add_argument("--precision", choices=("f32", "tf32", "bf16"), nargs="+", default=["f32"])
parser.add_argument("--dump")
args = parser.parse_args()
width, pixels, dims, batch = SIZES[args.size]
batch = args.batch or batch
device = torch.device(args.device)
if args.device == "cpu":
    torch.set_num_threads(args.threads)


def norm(channels):
    return nn.GroupNorm(max(channels // 16, 1), channels)


class Block(nn.Module):
    """ResNet's basic block with group norm, under torchvision's names."""

    def __init__(self, before, after, stride):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(before, after, 3, stride, 1, bias=False), norm(after)
        self.conv2, self.bn2 = nn.Conv2d(after, after, 3, 1, 1, bias=False), norm(after)
        self.downsample = None
        if stride != 1 or before != after:
            self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), norm(after))

    def forward(self, x):
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class Encoder(nn.Module):
    """ResNet-18 of another width, spatial softmax, linear layer: LeRobot's DiffusionRgbEncoder, with its names."""

    def __init__(self):
        super().__init__()
        stages, before = [], width
        for stage in range(4):
            after = width << stage
            stages.append(nn.Sequential(Block(before, after, 2 if stage else 1), Block(after, after, 1)))
            before = after
        stem = [nn.Conv2d(3, width, 7, 2, 3, bias=False), norm(width), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
        self.backbone = nn.Sequential(*stem, *stages)
        side = -(-pixels // 32)
        self.pool, self.out = SpatialSoftmax((width * 8, side, side), num_kp=32), nn.Linear(64, 64)

    def forward(self, x):
        return F.relu(self.out(self.pool(self.backbone(x)).flatten(1)))


config = DiffusionConfig(
    input_features={
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(15,)),
        "observation.images.table": PolicyFeature(type=FeatureType.VISUAL, shape=(3, pixels, pixels)),
    },
    output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(8,))},
    down_dims=dims,
    horizon=16,
    crop_shape=(pixels, pixels),
    pretrained_backbone_weights=None,
    use_group_norm=True,
    diffusion_step_embed_dim=128,
    push_to_hub=False,
    device=args.device,
)


class Policy(nn.Module):
    """Two cameras and two history steps through one shared encoder, then the U-Net."""

    def __init__(self):
        super().__init__()
        self.rgb_encoder = Encoder()
        self.unet = DiffusionConditionalUnet1d(config, global_cond_dim=2 * (15 + 2 * 64))

    def condition(self, images, state):
        features = self.rgb_encoder(images).reshape(state.shape[0], 2, 128)
        return torch.cat([state, features], -1).flatten(1)

    def forward(self, images, state, x, t):
        return self.unet(x, t, global_cond=self.condition(images, state))


schedule = DDIMScheduler(
    num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", clip_sample=True, prediction_type="epsilon"
)
schedule.set_timesteps(10)


def data(size, channels_last):
    """Images (size * 4, 3, H, W), a sample's in the order (step, camera); state, actions, timesteps, noise."""
    g = torch.Generator().manual_seed(0)
    images = torch.rand(size * 4, 3, pixels, pixels, generator=g).to(device)
    if channels_last:
        images = images.to(memory_format=torch.channels_last)
    state, actions = torch.randn(size, 2, 15, generator=g), torch.randn(size, 16, 8, generator=g)
    timesteps, noise = torch.randint(0, 100, (size,), generator=g), torch.randn(size, 16, 8, generator=g)
    return images, *(t.to(device) for t in (state, actions, timesteps, noise))


precision = args.precision[0]


def lower():
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")


def median(run):
    def wait():
        if device.type == "cuda":
            torch.cuda.synchronize()

    for _ in range(3):
        run()
    times = []
    for _ in range(args.repeats):
        wait()
        start = time.perf_counter()
        run()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return round(statistics.median(times), 2)


for precision, variant in [(p, v) for p in args.precision for v in ("default", "tuned")]:
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
    torch.manual_seed(0)
    tuned = variant == "tuned"
    policy = Policy().to(device)
    if tuned:
        policy = policy.to(memory_format=torch.channels_last)
    images, state, actions, timesteps, noise = data(batch, tuned)
    if args.dump and not tuned:
        from safetensors.torch import save_file

        tensors = {"diffusion." + k: v for k, v in policy.named_parameters()}
        tensors |= {"images": images.permute(0, 2, 3, 1), "state": state, "actions": actions, "noise": noise}
        tensors["timesteps"] = timesteps.float()
        save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, args.dump)
    optimiser = torch.optim.Adam(policy.parameters(), lr=2e-4, **({"fused": True} if tuned else {"foreach": True}))
    average = [p.detach().clone() for p in policy.parameters()]
    losses = []

    def step():
        noisy = schedule.add_noise(actions, noise, timesteps)
        with lower():
            prediction = policy(images, state, noisy, timesteps)
        loss = F.mse_loss(prediction.float(), noise)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
        torch._foreach_lerp_(average, [p.detach() for p in policy.parameters()], 0.001)
        losses.append(loss.item())

    def forward():
        with torch.no_grad(), lower():
            policy(images, state, actions, timesteps)

    def ddim(size):
        pictures, states, start, _, _ = data(size, tuned)

        def run():
            with torch.no_grad():
                with lower():
                    condition = policy.condition(pictures, states)
                y = start
                for k in schedule.timesteps:
                    t = torch.full((size,), int(k), device=device)
                    with lower():
                        output = policy.unet(y, t, global_cond=condition)
                    y = schedule.step(output.float(), k, y, eta=0.0).prev_sample

        return run

    line = {"peer": "torch " + torch.__version__, "variant": variant, "size": args.size, "device": args.device, "precision": precision}
    line |= {"batch": batch, "threads": args.threads, "params": sum(p.numel() for p in policy.parameters())}
    line |= {"forward": median(forward), "step": median(step), "ddim1": median(ddim(1)), "ddim8": median(ddim(8))}
    line |= {"rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, "loss": losses[0]}
    print(json.dumps(line), flush=True)

"""Writes sac.safetensors: one step of soft actor-critic by stable-baselines3 on a fixed batch with fixed noise.

python make_sac.py OUT_DIR

Two things are set as here and not as there: the logarithm of the deviation is -10 + 6 (1 + tanh r), and the critics have a layer
norm before each ReLU. Networks, losses, gradients, the step of Adam and the move of the targets are stable-baselines3's own.
"""

import sys

import gymnasium
import numpy as np
import torch
from safetensors.torch import save_file
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac import sac as module

OBS, ACT, ROWS, HIDDEN, LR = 5, 3, 8, [16, 12], 1e-3


class Spaces(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACT,), np.float32)

    def reset(self, seed=None, options=None):
        return np.zeros(OBS, np.float32), {}

    def step(self, action):
        return np.zeros(OBS, np.float32), 0.0, False, False, {}


torch.manual_seed(7)
torch.set_num_threads(1)
sac = SAC("MlpPolicy", Spaces(), learning_rate=LR, gamma=0.99, tau=0.01, ent_coef="auto_0.1", policy_kwargs={"net_arch": HIDDEN})
sac.set_logger(configure(None, []))
actor, critic, target = sac.actor, sac.critic, sac.critic_target

for net in (critic, target):
    net.q_networks = []
    for i in range(2):
        q = torch.nn.Sequential(*create_mlp(OBS + ACT, 1, HIDDEN, post_linear_modules=[torch.nn.LayerNorm]))
        net.add_module(f"qf{i}", q)
        net.q_networks.append(q)
for p in list(critic.parameters()) + list(target.parameters()) + list(actor.parameters()):
    # Larger than usual, so that nothing that is wrong can hide.
    p.data = torch.randn_like(p) * 0.4
# In double precision, as the density of a squashed action is 1 - a^2 there.
for net in (critic, target, actor):
    net.double()
    net.extract_features = lambda obs, extractor=None: obs  # which makes them single
critic.optimizer = torch.optim.Adam(critic.parameters(), lr=LR)
actor.optimizer = torch.optim.Adam(actor.parameters(), lr=LR)

raw = actor.get_action_dist_params


def deviations(obs):
    mean = actor.mu(actor.latent_pi(actor.extract_features(obs, actor.features_extractor)))
    r = actor.log_std(actor.latent_pi(actor.extract_features(obs, actor.features_extractor)))
    return mean, -10 + 6 * (1 + torch.tanh(r)), {}


actor.get_action_dist_params = deviations
actor.action_dist.epsilon = 0.0

names = {}
for i in range(2):
    for layer in range(3):
        names[f"q{i + 1}.{layer}"] = (f"qf{i}", 3 * layer)
        if layer < 2:
            names[f"q{i + 1}.{layer}.norm"] = (f"qf{i}", 3 * layer + 1)


def of_critic(net, grad=False):
    out = {}
    for name, (q, index) in names.items():
        for part in ("weight", "bias"):
            p = getattr(getattr(net, q)[index], part)
            out[f"{name}.{part}"] = (p.grad if grad else p.data).clone()
    return out


def of_actor(grad=False):
    get = (lambda p: p.grad.clone()) if grad else (lambda p: p.data.clone())
    out = {}
    for layer in range(2):
        for part in ("weight", "bias"):
            out[f"{layer}.{part}"] = get(getattr(actor.latent_pi[2 * layer], part))
    for part in ("weight", "bias"):
        out[f"2.{part}"] = torch.cat([get(getattr(actor.mu, part)), get(getattr(actor.log_std, part))])
    return out


def put(all, prefix, tensors):
    all.update({f"{prefix}.{k}": v.contiguous() for k, v in tensors.items()})


out = {}
put(out, "critics", of_critic(critic))
put(out, "targets", of_critic(target))
put(out, "actor", of_actor())
batch = ReplayBufferSamples(
    observations=torch.randn(ROWS, OBS),
    actions=torch.tanh(torch.randn(ROWS, ACT)),
    next_observations=torch.randn(ROWS, OBS),
    dones=(torch.arange(ROWS) % 3 == 0).float().reshape(-1, 1),
    rewards=torch.randn(ROWS, 1),
    discounts=None,
)
batch = ReplayBufferSamples(*(v if v is None else v.double() for v in batch))
out["batch.observation"], out["batch.action"] = batch.observations, batch.actions
out["batch.next"], out["batch.reward"] = batch.next_observations, batch.rewards
out["batch.bootstrap"] = 1 - batch.dones

# The noise of this state's action is drawn first, then the next one's.
noise = [torch.randn(ROWS, ACT).double(), torch.randn(ROWS, ACT).double()]
out["noise.actor"], out["noise.target"] = noise
drawn = iter(noise)
torch.distributions.Normal.rsample = lambda self, shape=torch.Size(): self.loc + self.scale * next(drawn)

seen = {}
mse = module.F.mse_loss


def watched(value, wanted):
    seen["targets"] = wanted.detach().clone()
    return mse(value, wanted)


module.F.mse_loss = watched
step = critic.optimizer.step


def critic_step(*a, **k):
    put(out, "grad.critics", of_critic(critic, grad=True))
    step(*a, **k)
    put(out, "after.critics", of_critic(critic))


critic.optimizer.step = critic_step
actor_step = actor.optimizer.step


def before_actor_step(*a, **k):
    put(out, "grad.actor", of_actor(grad=True))
    actor_step(*a, **k)


actor.optimizer.step = before_actor_step
alpha_step = sac.ent_coef_optimizer.step


def before_alpha_step(*a, **k):
    seen["alpha_grad"] = sac.log_ent_coef.grad.clone()
    alpha_step(*a, **k)


sac.ent_coef_optimizer.step = before_alpha_step


class Fixed:
    def sample(self, *a, **k):
        return batch


sac.replay_buffer = Fixed()
sac.target_entropy = -float(ACT)
sac.train(gradient_steps=1, batch_size=ROWS)
log = sac.logger.name_to_value
out["y"] = seen["targets"]
# stable-baselines3 halves the sum of both errors.
out["loss.critics"] = torch.tensor([2 * log["train/critic_loss"]])
out["loss.actor"] = torch.tensor([log["train/actor_loss"]])
out["grad.log_alpha"] = seen["alpha_grad"].reshape(1)
out["after.log_alpha"] = sac.log_ent_coef.detach().reshape(1)
put(out, "after.actor", of_actor())
put(out, "after.targets", of_critic(target))
save_file({k: v.float().contiguous() for k, v in out.items()}, f"{sys.argv[1]}/sac.safetensors")

#!/usr/bin/env bash
# `train` beside LeRobot's own lerobot-train: same dataset, same network, same settings, on the CPU. Prints loss curves, the loss on
# held-out episodes (both checkpoints opened by LeRobot, the same noise), and steps a second.
#
#   benches/peers/compare_train.sh [--steps 500] [--batch 16] [--seeds "0 1"]
#
# Makes its own Python environment (python3 -m venv, lerobot 0.4.4) under target/peers. Leave the machine otherwise idle.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=500 batch=16 seeds="0 1"
while [ $# -gt 0 ]; do
    case "$1" in
        --steps) steps=$2 ;;
        --batch) batch=$2 ;;
        --seeds) seeds=$2 ;;
        *) echo "compare_train.sh: unknown argument $1" >&2; exit 2 ;;
    esac
    shift 2
done

here=$PWD/target/peers
work=$here/train
mkdir -p "$here"
if [ ! -x "$here/venv/bin/python" ] || ! "$here/venv/bin/python" -c 'import lerobot, torch' 2>/dev/null; then
    echo "installing lerobot 0.4.4 into $here/venv" >&2
    python3 -m venv "$here/venv"
    "$here/venv/bin/pip" install --quiet "lerobot==0.4.4" >&2
fi
cargo build --quiet --release --locked --example train --example real_robot
rm -rf "$work"
mkdir -p "$work"
export HF_HUB_OFFLINE=1 HF_HOME=$work/hf OMP_NUM_THREADS=2
target/release/examples/real_robot record --episodes 24 --seed 0 --out "$work/recordings" >/dev/null
target/release/examples/real_robot record --episodes 8 --seed 1 --out "$work/held-out" >/dev/null

# LeRobot's defaults, but a network and a warm-up that suit the processor and so few steps. It has no average of the weights.
shared=(--policy.down_dims='[64,128,256]' --policy.pretrained_backbone_weights=null --policy.use_group_norm=true
    --policy.crop_shape=null --policy.optimizer_lr=3e-4 --policy.scheduler_warmup_steps=50)
ours=(--set 'policy.down_dims=[64,128,256]' --set policy.prediction=epsilon --set data.validation=0
    --set data.image_scaling=imagenet --set train.save_every="$steps" --set train.step.conditions="$batch" --set train.step.noises=1
    --set train.step.observation_noise=0 --set train.step.ema.max=0 --set train.step.adam.beta1=0.95
    --set train.step.adam.decoupled=false --set train.step.adam.clip_norm=10 --set train.step.schedule.lr=3e-4
    --set train.step.schedule.warmup=50 --set train.steps="$steps")
TIMEFORMAT="seconds %R"
for seed in $seeds; do
    echo "seed $seed: lerobot-train" >&2
    "$here/venv/bin/lerobot-train" --dataset.repo_id=local/recordings --dataset.root="$work/recordings" --policy.type=diffusion \
        --policy.push_to_hub=false --policy.device=cpu "${shared[@]}" --output_dir="$work/lerobot-$seed" --batch_size="$batch" \
        --steps="$steps" --save_freq="$steps" --log_freq=100 --eval_freq=0 --num_workers=0 --seed="$seed" >"$work/lerobot-$seed.log" 2>&1
    echo "seed $seed: train" >&2
    {
        time target/release/examples/train --dataset "$work/recordings" --preset laptop --seed "$seed" --threads 2 --quiet \
            --out "$work/ours-$seed" "${ours[@]}"
    } >"$work/ours-$seed.log" 2>&1
done
"$here/venv/bin/python" -W ignore benches/peers/validate_train.py "$work" "$steps" $seeds

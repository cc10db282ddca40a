#!/usr/bin/env bash
# A robot of one's own from end to end: records the easy task, turns it round, trains, serves, and counts successes.
#
#   examples/real_robot/run.sh DIR [--episodes N] [--trials N] [--preset smoke|laptop] [--set KEY=VALUE ...]
#
# DIR is made. A training that was stopped goes on when the same command is given again.
set -euo pipefail
out="${1:?expected a folder for everything that is made}"
shift
episodes=30 trials=20 preset=laptop sets=()
while [ $# -gt 0 ]; do
    case "$1" in
        --episodes) episodes=$2; shift ;;
        --trials) trials=$2; shift ;;
        --preset) preset=$2; shift ;;
        --set) sets+=(--set "$2"); shift ;;
        *) echo "run.sh: unknown argument $1" >&2; exit 2 ;;
    esac
    shift
done
# Programs that are built already may be named; otherwise cargo builds them here.
programs="${E2H_PROGRAMS:-}"
if [ -z "$programs" ]; then
    cd "$(dirname "$0")/../.."
    cargo build --release --quiet --example real_robot --example dataset --example refine --example train --example serve
    programs="${CARGO_TARGET_DIR:-target}/release/examples"
fi
mkdir -p "$out"

echo "== 1. record the easy task: the plug is pulled out"
[ -e "$out/recordings" ] || "$programs/real_robot" record --episodes "$episodes" --out "$out/recordings"

echo "== 2. look at the recording"
"$programs/dataset" check "$out/recordings"

echo "== 3. turn it round"
[ -e "$out/refined" ] || "$programs/refine" --dataset "$out/recordings" --out "$out/refined" --fps 15 \
    --pose observation.tcp_m --rotation none --gripper 'observation.state[0]' --gripper-range 0,80 \
    --state observation.state --task "plug it in"

echo "== 4. train"
resume=()
[ -e "$out/policy/training.json" ] && resume=(--resume)
"$programs/train" --dataset "$out/refined" --preset "$preset" --out "$out/policy" ${resume[@]+"${resume[@]}"} ${sets[@]+"${sets[@]}"}

echo "== 5. serve"
# Port 0: whichever is free; the line that the server prints says which.
"$programs/serve" --checkpoint "$out/policy/checkpoints/last/pretrained_model" --listen 127.0.0.1:0 > "$out/server.log" 2>&1 &
server=$!
trap 'kill "$server" 2> /dev/null || true; wait "$server" 2> /dev/null || true' EXIT
for _ in $(seq 300); do
    address="$(grep -o 'ws://[0-9.]*:[0-9]*' "$out/server.log" | head -n 1 || true)"
    [ -n "$address" ] && break
    kill -0 "$server" 2> /dev/null || { cat "$out/server.log" >&2; exit 1; }
    sleep 0.1
done
head -n 1 "$out/server.log"

echo "== 6. run the robot: it puts the plug in"
"$programs/real_robot" run --server "${address:?the server did not say where it listens}" --trials "$trials" --video "$out/trials.png"

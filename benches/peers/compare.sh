#!/usr/bin/env bash
# Ratios ours / PyTorch of a training step, a forward pass, sampling and peak memory, measured in turn on this machine.
#
#   benches/peers/compare.sh [--json] [--pairs N] [--size laptop|paper]
#
# Makes its own Python environment (python3 -m venv, lerobot 0.4.4) under target/peers. Leave the machine otherwise idle.
set -euo pipefail
cd "$(dirname "$0")/../.."

json=0 pairs=5 sizes="laptop paper"
while [ $# -gt 0 ]; do
    case "$1" in
        --json) json=1 ;;
        --pairs) pairs=$2; shift ;;
        --size) sizes=$2; shift ;;
        *) echo "compare.sh: unknown argument $1" >&2; exit 2 ;;
    esac
    shift
done

here=target/peers
mkdir -p "$here"
if [ ! -x "$here/venv/bin/python" ] || ! "$here/venv/bin/python" -c 'import lerobot, torch' 2>/dev/null; then
    echo "installing lerobot 0.4.4 into $here/venv" >&2
    python3 -m venv "$here/venv"
    "$here/venv/bin/pip" install --quiet "lerobot==0.4.4" >&2
fi
cargo build --quiet --release --example peer
rm -f "$here"/*.jsonl
for size in $sizes; do
    for pair in $(seq "$pairs"); do
        echo "$size: pair $pair of $pairs" >&2
        "$here/venv/bin/python" -W ignore benches/peers/train_step.py --size "$size" \
            --dump "$here/$size.safetensors" 2>/dev/null >>"$here/$size.torch.jsonl"
        target/release/examples/peer --json --size "$size" --data "$here/$size.safetensors" >>"$here/$size.ours.jsonl"
    done
done
JSON=$json SIZES=$sizes "$here/venv/bin/python" - <<'PY'
import json, os, statistics, sys

bad = False
for size in os.environ["SIZES"].split():
    read = lambda who: [json.loads(line) for line in open(f"target/peers/{size}.{who}.jsonl")]
    torch, ours = read("torch"), read("ours")
    rows = {}
    for key in ("step", "forward", "ddim1", "ddim8", "rss_mb"):
        # The better of PyTorch's two variants, which run in one process; the first has the lower peak.
        pairs = zip(ours, zip(torch[::2], torch[1::2]))
        rows[key] = [o[key] / min(t[key] for t in both) for o, both in pairs]
    table = {k.removesuffix("_mb"): [round(f(v), 3) for f in (min, statistics.median, max)] for k, v in rows.items()}
    apart = max(abs(o["loss"] - t["loss"]) / abs(t["loss"]) for o, t in zip(ours, torch[::2]))
    if apart > 1e-5 or ours[0]["params"] != torch[0]["params"]:
        print(f"{size}: not the same model: loss differs by {apart:.1e}, {ours[0]['params']} and {torch[0]['params']} parameters", file=sys.stderr)
        bad = True
    if os.environ["JSON"] == "1":
        print(json.dumps({"size": size, **table}))
        continue
    print(f"{size}: {len(ours)} pairs, ours / {torch[0]['peer']} (the faster variant of each figure); first loss {apart:.0e} apart")
    for key, (low, middle, high) in table.items():
        absolute = statistics.median(o[key if key != 'rss' else 'rss_mb'] for o in ours)
        print(f"  {key:8} {middle:.2f}  ({low:.2f} to {high:.2f})   ours {absolute:.0f} {'MB' if key == 'rss' else 'ms'}")
sys.exit(bad)
PY

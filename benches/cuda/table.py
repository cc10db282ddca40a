"""Ratios ours / PyTorch of what `run.sh compare` wrote: median of the rounds (least to most), and our milliseconds.

    python table.py OURS.jsonl TORCH.jsonl

PyTorch's figure is the smaller of its two variants, figure by figure. Fails where the losses of the first step are apart.
"""

import json
import statistics
import sys

ours, torch = ([json.loads(line) for line in open(name)] for name in sys.argv[1:])
pairs = {}
for o, both in zip(ours, zip(torch[::2], torch[1::2])):
    precision = "bf16" if o["bf16"] else "tf32" if o["tf32"] else "f32"
    assert all((t["size"], t["precision"]) == (o["size"], precision) for t in both), "files of other runs"
    pairs.setdefault((o["size"], precision), []).append((o, both))
# TF32 keeps 10 bits of each factor, bf16 seven.
NEAR = {"f32": 1e-5, "tf32": 2e-3, "bf16": 2e-2}
bad = False
print(f"ours / {torch[0]['peer']}")
for (size, precision), rows in pairs.items():
    apart = max(abs(o["loss"] - t["loss"]) / abs(t["loss"]) for o, (t, _) in rows)
    bad |= not apart <= NEAR[precision] or rows[0][0]["params"] != rows[0][1][0]["params"]
    line = f"{size:6} {precision:4}  first loss {apart:.0e} apart"
    for key in ("step", "forward", "ddim1", "ddim8"):
        ratios = [o[key] / min(t[key] for t in both) for o, both in rows]
        ms = statistics.median(o[key] for o, _ in rows)
        line += f" | {key} {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}), {ms:.2f} ms"
    print(line)
sys.exit(bad)

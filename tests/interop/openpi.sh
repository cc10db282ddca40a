#!/usr/bin/env bash
# Does openpi's own client, as it is on PyPI, work with a server of ours? Its packages go into a virtual environment of their own
# (E2H_OPENPI_ENV, by default below target/), once.
# Exit status: 0 everything holds, 1 something does not, 3 the packages could not be installed and nothing was run.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
environment="${E2H_OPENPI_ENV:-$root/target/interop/openpi}"
python="$environment/bin/python"
if ! cmp --silent "$here/openpi_requirements.txt" "$environment/installed.txt"; then
    echo "installing openpi-client into $environment"
    if ! why="$({ python3 -m venv "$environment" && "$python" -m pip install --quiet -r "$here/openpi_requirements.txt"; } 2>&1)"; then
        echo "NOT RUN: openpi-client could not be installed: $(grep -v '^$\|notice' <<< "$why" | tail -n 1)"
        exit 3
    fi
    cp "$here/openpi_requirements.txt" "$environment/installed.txt"
fi

cd "$root"
cargo build --release --quiet --locked --example serve
work="$(mktemp -d)"
E2H_TOKEN=sesame "${CARGO_TARGET_DIR:-$root/target}/release/examples/serve" --checkpoint checkpoints/nut_assembly \
    --listen 127.0.0.1:0 > "$work/said" &
server=$!
trap 'kill "$server" 2> /dev/null || true; rm -rf "$work"' EXIT
for _ in $(seq 100); do
    grep -q "^ws://" "$work/said" && break
    kill -0 "$server"
    sleep 0.1
done
port="$(sed -n 's|^ws://127.0.0.1:\([0-9]*\):.*|\1|p' "$work/said")"
actions="$(sed -n 's|.*; \([0-9]*\) actions of 8 numbers$|\1|p' "$work/said")"
"$python" "$here/openpi.py" "$port" "$actions"
kill -TERM "$server"
status=0; wait "$server" || status=$?
test "$status" = 143
echo "all checks with openpi's client hold"

#!/usr/bin/env bash
# Latency of one and of eight clients: `serve`, and openpi's own server around the same network of LeRobot's in torch. In turn on this
# machine, one thread each; the clients are openpi's.
#
#   benches/peers/compare_serve.sh [--rounds N]
#
# E2H_INTEROP_ENV names the environment of tests/interop/run.sh, which has LeRobot. openpi's server is no package: OPENPI names a
# checkout of github.com/Physical-Intelligence/openpi.
set -euo pipefail
cd "$(dirname "$0")/../.."

rounds=3
[ "${1:-}" = --rounds ] && rounds=$2
here=target/peers
python="${E2H_INTEROP_ENV:-target/interop/environment}/bin/python"
[ -x "$python" ] || { echo "no LeRobot in $python: tests/interop/run.sh installs it" >&2; exit 2; }
server="${OPENPI:?expected a checkout of openpi}/src/openpi/serving/websocket_policy_server.py"
if [ ! -e "$here/openpi/installed" ]; then
    "$python" -m pip install --quiet --no-deps --target "$here/openpi" openpi-client==0.1.2 websockets==17.4 msgpack==1.2.4
    touch "$here/openpi/installed"
fi
# The server alone: its package would bring JAX.
mkdir -p "$here/openpi/openpi/serving"
cp "$server" "$here/openpi/openpi/serving/"
export PYTHONPATH="$PWD/$here/openpi" HF_HUB_OFFLINE=1 CUDA_VISIBLE_DEVICES="" OMP_NUM_THREADS=1
cargo build --quiet --release --example serve
[ -e "$here/served/config.json" ] || "$python" -W ignore benches/peers/serve.py make "$here/served" 2> /dev/null

running=""
trap '[ -z "$running" ] || kill "$running"' EXIT
measure() {
    local who=$1 port=$2
    shift 2
    "$@" > "$here/serve.log" 2>&1 &
    running=$!
    until curl --silent --fail "http://127.0.0.1:$port/healthz" > /dev/null; do kill -0 "$running"; sleep 0.2; done
    for clients in 1 8; do
        echo "{\"server\":\"$who\"} $("$python" -W ignore benches/peers/serve.py load "$port" "$clients" $((clients == 1 ? 20 : 5)))"
    done
    kill "$running"
    wait "$running" || true
    running=""
}
for _ in $(seq "$rounds"); do
    measure openpi 18431 "$python" -W ignore benches/peers/serve.py serve "$here/served" 18431
    measure ours 18432 target/release/examples/serve --checkpoint "$here/served" --listen 127.0.0.1:18432 --threads 1
done

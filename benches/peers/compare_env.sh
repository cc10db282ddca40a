#!/usr/bin/env bash
# Control steps a second with two cameras at 128 pixels: ours, Python MuJoCo on our own scene (each GL library that works here), and
# robosuite's square nut. In turn on this machine, one process each.
#
#   benches/peers/compare_env.sh [--rounds N]
set -euo pipefail
cd "$(dirname "$0")/../.."

rounds=3
[ "${1:-}" = --rounds ] && rounds=$2
here=target/peers
mkdir -p "$here"
# robosuite 1.5.2 does not start with MuJoCo 3.17, hence two environments.
environment() {
    local folder=$here/$1
    shift
    if ! "$folder/bin/python" -c 'import mujoco' 2>/dev/null; then
        echo "installing $* into $folder" >&2
        python3 -m venv "$folder"
        "$folder/bin/pip" install --quiet "$@" >&2
    fi
}
environment env-venv "mujoco==3.17.0"
environment robosuite-venv "robosuite==1.5.2" "mujoco==3.3.1"
cargo build --quiet --release --example env_step
target/release/examples/env_step --scene "$here/nut_assembly.xml"
for _ in $(seq "$rounds"); do
    target/release/examples/env_step --json
    target/release/examples/env_step --json --threads 2
    for gl in egl osmesa; do
        MUJOCO_GL=$gl "$here/env-venv/bin/python" -W ignore benches/peers/env_step.py mujoco "$here/nut_assembly.xml" table wrist 2>/dev/null ||
            echo "{\"peer\":\"mujoco\",\"gl\":\"$gl\",\"error\":\"does not work here\"}"
        MUJOCO_GL=$gl "$here/robosuite-venv/bin/python" -W ignore benches/peers/env_step.py robosuite NutAssemblySquare --steps 60 2>/dev/null |
            grep '^{' ||
            echo "{\"peer\":\"robosuite\",\"gl\":\"$gl\",\"error\":\"does not work here\"}"
    done
done

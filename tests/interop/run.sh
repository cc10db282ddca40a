#!/usr/bin/env bash
# Do LeRobot and this project open, compare and extend each other's datasets? Opt-in: it needs Python 3.10 to 3.12 and some
# gigabytes of packages, which go into a virtual environment of its own (E2H_INTEROP_ENV, by default below target/).
# Exit status: 0 everything holds, 1 something does not, 3 the packages could not be installed and nothing was run.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
environment="${E2H_INTEROP_ENV:-$root/target/interop/environment}"
python="$environment/bin/python"

if ! "$python" -c 'import lerobot' 2> /dev/null; then
    echo "installing LeRobot into $environment"
    if ! { python3 -m venv "$environment" && "$python" -m pip install --quiet -r "$here/requirements.txt"; }; then
        echo "NOT RUN: the packages of tests/interop/requirements.txt could not be installed"
        exit 3
    fi
fi

cd "$root"
cargo build --release --quiet --example interop --example dataset --example refine
programs="${CARGO_TARGET_DIR:-$root/target}/release/examples"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
export HF_HUB_OFFLINE=1 HF_HOME="$work/hf" CUDA_VISIBLE_DEVICES="" TOKENIZERS_PARALLELISM=false

lerobot() { "$python" -W ignore "$here/interop.py" "$@" 2> "$work/stderr" || { cat "$work/stderr"; exit 1; }; }

echo "== a dataset written here"
"$programs/interop" write "$work/ours"
lerobot compare "$programs/interop" "$work/ours"
lerobot statistics "$work/ours"
lerobot windows "$work/ours"
"$programs/dataset" check "$work/ours"

echo "== LeRobot goes on with it, then we do"
lerobot append "$work/ours"
"$programs/interop" append "$work/ours"
lerobot compare "$programs/interop" "$work/ours"
"$programs/dataset" check "$work/ours"

echo "== a dataset written by LeRobot"
lerobot foreign "$work/theirs"
lerobot compare "$programs/interop" "$work/theirs"
"$programs/dataset" check "$work/theirs"
"$programs/interop" append "$work/theirs"
lerobot compare "$programs/interop" "$work/theirs"
lerobot statistics "$work/theirs"

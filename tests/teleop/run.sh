#!/usr/bin/env bash
# The real window of the example `teleop` on a virtual display: synthetic keys record a demonstration, the process is killed in the
# next, and a run learns from what is there. The first argument is a folder for screenshots. Status 3: not run here, and why.
set -euo pipefail
cd "$(dirname "$0")/../.."

for program in Xvfb xdotool import python3; do
    if ! command -v "$program" > /dev/null; then
        echo "NOT RUN: no $program (Debian: xvfb, xdotool, imagemagick, python3, libgl1-mesa-dri, libxkbcommon-x11-0)"
        exit 3
    fi
done
if ! pkg-config --exists libudev 2> /dev/null; then
    echo "NOT RUN: no libudev to build the feature viewer with (Debian: libudev-dev, pkg-config)"
    exit 3
fi

cargo build --release --locked --features viewer --example teleop --example nut_assembly
work=$(mktemp -d)
shots=${1:-$work}
mkdir -p "$shots"
display_file=$work/display
exec 5> "$display_file"
Xvfb -displayfd 5 -screen 0 1280x720x24 -nolisten tcp > "$work/xvfb.log" 2>&1 &
xvfb=$!
trap 'kill "$xvfb" 2> /dev/null || true; rm -rf "$work"' EXIT
for _ in $(seq 100); do [ -s "$display_file" ] && break; sleep 0.1; done
export DISPLAY=:$(cat "$display_file") LIBGL_ALWAYS_SOFTWARE=1 XDG_RUNTIME_DIR=$work
unset WAYLAND_DISPLAY

python3 tests/teleop/drive.py target/release/examples/teleop "$work/by_hand" "$shots"
target/release/examples/nut_assembly --preset smoke --quiet --demonstrations "$work/by_hand" --out "$work/run" \
    --set=loop.iterations=0 --set=train.easy_steps=12 --set=train.initial_steps=12 > "$work/run.log"
grep -q "1 of 1 episodes of" "$work/run/report.html"
echo "ok: one demonstration recorded in the window, and learned from"

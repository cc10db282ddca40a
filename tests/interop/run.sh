#!/usr/bin/env bash
# Do LeRobot and this project open, compare and extend each other's datasets, and open each other's policies? It needs Python
# 3.10 to 3.12 and six gigabytes of packages, which go into a virtual environment of its own (E2H_INTEROP_ENV, by default
# below target/), once.
# Exit status: 0 everything holds, 1 something does not, 2 a folder that is not ours, 3 the packages could not be installed and
# nothing was run.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
environment="${E2H_INTEROP_ENV:-$root/target/interop/environment}"
python="$environment/bin/python"

# An environment is whole when it says what was installed; one that was cut off, or is of other versions, is made anew. Of
# folders elsewhere only those are taken for ours that say so.
if [ -n "${E2H_INTEROP_ENV:-}" ] && [ -e "$environment" ] && [ ! -e "$environment/installed.txt" ]; then
    echo "E2H_INTEROP_ENV: expected a new folder or one that this script made, found $environment" >&2
    exit 2
fi
if ! cmp --silent "$here/requirements.txt" "$environment/installed.txt"; then
    echo "installing LeRobot into $environment"
    rm -rf "$environment"
    # Empty for now: ours, and not whole.
    mkdir -p "$environment"
    : > "$environment/installed.txt"
    if ! why="$({ python3 -m venv "$environment" && "$python" -m pip install --quiet -r "$here/requirements.txt"; } 2>&1)"; then
        echo "NOT RUN: LeRobot's packages could not be installed: $(grep -v '^$\|notice' <<< "$why" | tail -n 1)"
        exit 3
    fi
    cp "$here/requirements.txt" "$environment/installed.txt"
fi

cd "$root"
cargo build --release --quiet --locked --example interop --example dataset --example refine --example lerobot_actions --example export --example train
programs="${CARGO_TARGET_DIR:-$root/target}/release/examples"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
export HF_HUB_OFFLINE=1 HF_HOME="$work/hf" CUDA_VISIBLE_DEVICES="" TOKENIZERS_PARALLELISM=false

script() { "$python" -W ignore "$here/$1" "${@:2}" 2> "$work/stderr" || { cat "$work/stderr"; exit 1; }; }
lerobot() { script interop.py "$@"; }
policies() { script policies.py "$@"; }

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

echo "== another robot's recording becomes hard-direction data that LeRobot trains on"
"$programs/refine" --dataset "$work/theirs" --out "$work/refined" --pose observation.tcp --rotation xyzw \
    --gripper observation.jaw_mm --gripper-range 0,80 --state observation.state --task "plug it in"
"$programs/dataset" check "$work/refined"
lerobot compare "$programs/interop" "$work/refined"
lerobot statistics "$work/refined"
lerobot refined "$work/theirs" "$work/refined"
lerobot train "$work/refined"

echo "== a policy that is trained here on that opens in LeRobot, and so does one of the recording itself"
for dataset in refined theirs; do
    "$programs/train" --dataset "$work/$dataset" --preset smoke --quiet --set data.validation=0.3 --set data.resize=[48,64] \
        --out "$work/trained-$dataset"
    # The check writes beside the folder that it is given.
    cp -rL "$work/trained-$dataset/checkpoints/last/pretrained_model" "$work/trained"
    policies trained "$programs/lerobot_actions" "$work/trained"
    rm -r "$work/trained"
done

echo "== we go on with a dataset of LeRobot's"
"$programs/interop" append "$work/theirs"
lerobot compare "$programs/interop" "$work/theirs"
"$programs/dataset" check "$work/theirs"

echo "== a video dataset written by LeRobot"
lerobot foreign-video "$work/video"
echo "without a decoder:"
! E2H_FFMPEG="$work/no-ffmpeg" "$programs/interop" dump "$work/video" > /dev/null 2> "$work/stderr"
grep -h "no-ffmpeg" "$work/stderr" | head -n 1
# LeRobot's packages bring a decoder of their own; any other does as well.
export E2H_FFMPEG="${E2H_FFMPEG:-$(command -v ffmpeg || "$python" -c 'import imageio_ffmpeg as f; print(f.get_ffmpeg_exe())' 2> /dev/null || true)}"
if [ -n "$E2H_FFMPEG" ]; then
    lerobot video "$programs/interop" "$work/video"
    "$programs/dataset" check "$work/video"
    echo "and a policy trained on it:"
    "$programs/train" --dataset "$work/video" --preset smoke --quiet --set data.resize=[48,64] --out "$work/trained-video"
    cp -rL "$work/trained-video/checkpoints/last/pretrained_model" "$work/trained"
    policies trained "$programs/lerobot_actions" "$work/trained"
    rm -r "$work/trained"
else
    echo "NOT RUN: no ffmpeg to decode the video with"
fi

echo "== LeRobot merges, deletes and splits; no row is lost, and a repair takes places and statistics anew"
lerobot edit "$work/theirs" "$work/edited"
for edited in "$work/edited"/*; do
    status=0; "$programs/dataset" check "$edited" || status=$?
    test "$status" = 0 -o "$status" = 3
    "$programs/dataset" check "$edited" --repair
    lerobot compare "$programs/interop" "$edited"
done

echo "== a policy trained here opens in LeRobot"
"$programs/lerobot_actions" make "$work/policy"
"$programs/export" --checkpoint "$work/policy" --lerobot "$work/published"
policies ours "$programs/lerobot_actions" "$work/policy" "$work/published"
if "$programs/export" --checkpoint "$root/checkpoints/nut_assembly" --lerobot "$work/refused" 2> "$work/stderr"; then
    echo "a policy that LeRobot cannot express was exported"
    exit 1
fi
grep -h "^Error" "$work/stderr" | tr ';' '\n'
test ! -e "$work/refused"

echo "== policies of LeRobot's open here"
mkdir "$work/theirs-policies"
policies theirs "$programs/lerobot_actions" "$programs/export" "$work/theirs-policies"

echo "all interop checks hold"

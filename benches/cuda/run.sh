#!/usr/bin/env bash
# On a machine with a GPU: the tests of the networks there, our speed beside PyTorch's, and a stage of the method at the paper's size.
#
#   benches/cuda/run.sh [test] [compare] [stage] [loop]       (without words: all of them)
#
#   DEVICE=cuda     or cuda:N
#   ROUNDS=3        of compare, ours and PyTorch's in turn, the median of REPEATS=20 runs each
#   PYTHON=python3  for compare: one with torch and lerobot 0.4.4; where it has not, they are installed below target/peers
#
# Starts what benches/cuda/build.sh left in target/cuda/dist. Needs NVIDIA's driver (580 or newer) and cuBLAS and cuRAND 13: a
# toolkit's, those beside torch in PYTHON, or else as Python packages below target/cuda/run (about 600 MB). cuDNN 9 is found
# where it lies beside them; E2H_CONVOLUTION=large uses it for large convolutions, E2H_CONVOLUTION=cudnn wherever it can.
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD dist=$PWD/target/cuda/dist venv=$PWD/target/cuda/run device=${DEVICE:-cuda} python=${PYTHON:-python3}
[ $# -gt 0 ] || set -- test compare stage loop
if [ ! -x "$dist/peer" ]; then
    echo "run.sh: expected $dist/peer, found none; build it with benches/cuda/build.sh" >&2
    exit 1
fi

packages() { "$1" -c 'import site, sysconfig; print(*{sysconfig.get_paths()["purelib"], *site.getsitepackages()}, sep="\n")'; }
folders=() optional=()
search() {
    local folder
    for folder in "$@"; do
        if [ -e "$folder/libcublas.so.13" ] || [ -e "$folder/libcurand.so.10" ]; then
            folders+=("$folder")
        elif [ -e "$folder/libcudnn.so.9" ]; then
            optional+=("$folder")
        fi
    done
}
while read -r site; do search "$site"/nvidia/*/lib; done < <(packages "$python")
search /usr/local/cuda/lib64 /usr/local/cuda/targets/x86_64-linux/lib
if [ ${#folders[@]} -eq 0 ]; then
    if [ ! -x "$venv/bin/python" ]; then
        "$python" -m venv "$venv"
        "$venv/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: "nvidia-cublas>=13,<14" "nvidia-curand>=10.4,<11"
    fi
    while read -r site; do search "$site"/nvidia/*/lib; done < <(packages "$venv/bin/python")
fi
folders+=(${optional[@]+"${optional[@]}"})
LIBRARIES=$(IFS=:; echo "${folders[*]}")${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
ours() { LD_LIBRARY_PATH=$LIBRARIES "$@"; }
# The driver compiles each kernel on its first use and keeps it here.
export CUDA_CACHE_PATH=${CUDA_CACHE_PATH:-$root/target/cuda/kernels} CUDA_CACHE_MAXSIZE=4294967296

for what in "$@"; do
    case $what in
        test)
            for program in "$dist"/test.*; do
                package=$(basename "$program" | cut -d. -f2)
                # Every comparison with our kernels and with LeRobot's numbers, on the GPU. One thread: one stream.
                (cd "crates/$package" && E2H_TEST_DEVICE=$device ours "$program" --test-threads 1 --skip examples::)
            done ;;
        compare)
            peers=target/peers
            mkdir -p "$peers"
            if ! "$python" -c 'import diffusers, lerobot, torch' 2>/dev/null; then
                if ! "$peers/venv/bin/python" -c 'import lerobot, torch' 2>/dev/null; then
                    python3 -m venv "$peers/venv"
                    "$peers/venv/bin/pip" install --quiet "lerobot==0.4.4"
                fi
                python=$PWD/$peers/venv/bin/python
            fi
            rm -f "$peers"/cuda.*.jsonl
            for round in $(seq "${ROUNDS:-3}"); do
                for size in laptop paper; do
                    echo "round $round: $size" >&2
                    "$python" -W ignore benches/peers/train_step.py --size $size --device "$device" --precision f32 tf32 bf16 \
                        --repeats "${REPEATS:-20}" --dump "$peers/$size.safetensors" >>"$peers/cuda.torch.jsonl"
                    # The same weights and data: the losses of the first step have to agree.
                    for option in "" --tf32 --bf16; do
                        # shellcheck disable=SC2086
                        ours "$dist/peer" --json --device "$device" --size $size $option --repeats "${REPEATS:-20}" \
                            --data "$peers/$size.safetensors" >>"$peers/cuda.ours.jsonl"
                    done
                done
            done
            "$python" benches/cuda/table.py "$peers/cuda.ours.jsonl" "$peers/cuda.torch.jsonl" ;;
        stage)
            # Demonstrations of the nut and training at the paper's sizes, but few steps: one stage on real episodes.
            out=$(mktemp -d)
            ours "$dist/nut_assembly" --preset paper --device "$device" --set device.bf16=true --out "$out/run" \
                --set loop.demonstrations=4 --set train.easy_steps=100 --set train.initial_steps=100 --set loop.iterations=0 \
                --set evaluation.trials=2 ;;
        loop)
            out=$(mktemp -d)
            ours "$dist/nut_assembly" --preset smoke --device "$device" --out "$out/run" ;;
        *) echo "run.sh: expected test, compare, stage or loop, found $what" >&2; exit 2 ;;
    esac
done

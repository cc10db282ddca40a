#!/usr/bin/env bash
# On a machine with a GPU: the tests of the networks there, our speed, PyTorch's, and a short run of the whole method.
#
#   benches/cuda/run.sh [test] [peer] [torch] [loop]       (without words: all of them)
#
#   DEVICE=cuda     or cuda:N
#
# Starts what benches/cuda/build.sh left in target/cuda/dist. Needs NVIDIA's driver (580 or newer), and Python with pip for
# the libraries (cuBLAS and cuRAND, about 600 MB) and, for torch, lerobot 0.4.4; a CUDA 13 toolkit will do for the former.
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD dist=$PWD/target/cuda/dist venv=$PWD/target/cuda/run device=${DEVICE:-cuda}
[ $# -gt 0 ] || set -- test peer torch loop
if [ ! -x "$dist/peer" ]; then
    echo "run.sh: expected $dist/peer, found none; build it with benches/cuda/build.sh" >&2
    exit 1
fi
if ! ls /usr/local/cuda/lib64/libcublas.so.13 "$venv"/lib/python3*/site-packages/nvidia/cu13/lib/libcublas.so.13 >/dev/null 2>&1; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: "nvidia-cublas>=13,<14" "nvidia-curand>=10.4,<11"
fi
for folder in "$venv"/lib/python3*/site-packages/nvidia/*/lib /usr/local/cuda/lib64; do
    [ ! -d "$folder" ] || LD_LIBRARY_PATH=$folder:${LD_LIBRARY_PATH:-}
done
export LD_LIBRARY_PATH
# The driver compiles each kernel on its first use and keeps it here.
export CUDA_CACHE_PATH=${CUDA_CACHE_PATH:-$root/target/cuda/kernels} CUDA_CACHE_MAXSIZE=4294967296

for what in "$@"; do
    case $what in
        test)
            for program in "$dist"/test.*; do
                package=$(basename "$program" | cut -d. -f2)
                # Every comparison with our kernels and with LeRobot's numbers, on the GPU. One thread: one stream.
                (cd "crates/$package" && E2H_TEST_DEVICE=$device "$program" --test-threads 1)
            done ;;
        peer)
            for size in laptop paper; do
                for options in "" --tf32 --bf16; do
                    # shellcheck disable=SC2086
                    "$dist/peer" --json --device "$device" --size $size $options
                done
            done ;;
        torch)
            peers=target/peers
            if ! "$peers/venv/bin/python" -c 'import lerobot, torch' 2>/dev/null; then
                python3 -m venv "$peers/venv"
                "$peers/venv/bin/pip" install --quiet "lerobot==0.4.4"
            fi
            for size in laptop paper; do
                env -u LD_LIBRARY_PATH "$peers/venv/bin/python" -W ignore benches/peers/train_step.py --size $size --device "$device" \
                    --dump "$peers/$size.safetensors"
                # The same weights and data: the losses of the first step have to agree.
                "$dist/peer" --json --device "$device" --size $size --data "$peers/$size.safetensors"
            done ;;
        loop)
            out=$(mktemp -d)
            "$dist/nut_assembly" --preset smoke --device "$device" --out "$out/run" ;;
        *) echo "run.sh: expected test, peer, torch or loop, found $what" >&2; exit 2 ;;
    esac
done

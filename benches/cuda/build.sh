#!/usr/bin/env bash
# Builds the tests of the networks and the examples peer, nut_assembly, compare and evaluate with CUDA, on a machine with or without
# GPU, driver and toolkit, into target/cuda/dist. benches/cuda/run.sh starts them on a machine with a GPU.
#
#   benches/cuda/build.sh [--check]        --check: only clippy on the crate that has the kernels; links nothing.
#                                          Status 3: nvcc could not be installed, and nothing was checked
#
#   CAPABILITY=90   compute capability times ten: 90 for H100 and H200 alone, 80 for these and all from A100 on
#   JOBS=2
#
# Takes nvcc 13.0 as Python wheels (105 MB). A newer one writes PTX that drivers of the 580 series refuse.
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD check=0
[ "${1:-}" != --check ] || check=1
capability=${CAPABILITY:-90} jobs=${JOBS:-2}
triple=x86_64-unknown-linux-gnu
here=$root/target/cuda
mkdir -p "$here/link" "$here/bin"

if [ ! -x "$here/venv/bin/python" ] || ! ls "$here"/venv/lib/python3*/site-packages/nvidia/cu13/bin/nvcc >/dev/null 2>&1; then
    echo "installing nvcc into $here/venv" >&2
    if ! { python3 -m venv "$here/venv" && "$here/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps --only-binary :all: \
        nvidia-cuda-nvcc==13.0.88 nvidia-nvvm==13.0.88 nvidia-cuda-crt==13.0.88 \
        nvidia-cuda-runtime==13.0.96 nvidia-cuda-cccl==13.0.85; }; then
        echo "NOT RUN: nvcc could not be installed from Python wheels" >&2
        exit 3
    fi
fi
toolkit=$(echo "$here"/venv/lib/python3*/site-packages/nvidia/cu13)

# The linker is asked for these by name, but takes nothing from them: every function is looked up when the program runs.
for name in cuda nvrtc curand cublas cublasLt; do
    [ -e "$here/link/lib$name.so" ] || gcc -shared -x c /dev/null -o "$here/link/lib$name.so"
done
ln -sfn "$toolkit/lib/libcudart_static.a" "$here/link/libcudart.a"
ln -sfn link "$here/lib" # CUDA_HOME/lib is where cudarc tells the linker to look

# Kernels for quantised and mixture-of-experts models take most of the time to compile and are never called here: in their
# place stand functions that abort.
cargo fetch --locked --target "$triple" >&2
source=$(cargo metadata --locked --format-version 1 --features cuda --filter-platform "$triple" |
    python3 -c 'import json, sys; print(next(p["manifest_path"] for p in json.load(sys.stdin)["packages"] if p["name"] == "candle-kernels"))')
{
    printf '#include <stdlib.h>\n'
    grep -oP 'pub fn \K\w+' "$(dirname "$source")/src/ffi.rs" | sort -u | sed 's/.*/void &(void) { abort(); }/'
} >"$here/left_out.c"
cat >"$here/bin/nvcc" <<'EOF'
#!/usr/bin/env bash
file=$(basename "${@: -1}") out= before=
case $file in
    moe_*.cu | mmvq_*.cu | mmq_*.cu)
        for word in "$@"; do [ "$before" != -o ] || out=$word; before=$word; done
        if [ "$file" = mmq_quantize.cu ]; then exec gcc -O1 -fPIC -c "$(dirname "$0")/../left_out.c" -o "$out"; fi
        exec gcc -fPIC -c -x c /dev/null -o "$out" ;;
esac
exec "$NVCC_OF_TOOLKIT" "$@"
EOF
chmod +x "$here/bin/nvcc"

# With --target, RUSTFLAGS do not reach build scripts: cudarc's refuses to be linked and loaded at once, but its sources only
# ask whether it is loaded. The program then starts without any CUDA library.
export NVCC_OF_TOOLKIT=$toolkit/bin/nvcc NVCC=$here/bin/nvcc NVCC_CCBIN=${NVCC_CCBIN:-$(command -v g++)}
export PATH=$toolkit/bin:$toolkit/nvvm/bin:$PATH CUDA_HOME=$here CUDA_COMPUTE_CAP=$capability
export CUDARC_CUDA_VERSION=13000 CUDAFORGE_THREADS=$jobs CARGO_TARGET_DIR=$here/build
export RUSTFLAGS="${RUSTFLAGS:-} --cfg feature=\"dynamic-loading\""
unset CUDA_PATH CUDA_ROOT CUDA_TOOLKIT_ROOT_DIR CUDNN_LIB
common=(--release --locked --target "$triple" -j "$jobs")
if [ "$check" = 1 ]; then
    exec cargo clippy "${common[@]}" -p e2h-nn --all-targets --features e2h-nn/cuda -- -D warnings
fi
# The same packages for both, so that nothing below them is compiled twice.
common+=(-p auto-e2h -p e2h-nn -p e2h-policy --features auto-e2h/cuda,e2h-nn/cuda,e2h-policy/cuda)
programs=(peer nut_assembly compare evaluate)
tests=(--test nn --test candle --test golden)

cargo build "${common[@]}" "${programs[@]/#/--example=}"
dist=$here/dist
rm -rf "$dist"
mkdir -p "$dist"
cargo test "${common[@]}" "${tests[@]}" --no-run --message-format json |
    python3 -c '
import json, sys
for line in sys.stdin:
    made = json.loads(line)
    if made.get("executable") and made["profile"]["test"]:
        print(made["package_id"].split("/")[-1].split("#")[0], made["target"]["name"], made["executable"])' |
    while read -r package name file; do cp "$file" "$dist/test.$package.$name"; done
built=$here/build/$triple/release
cp "${programs[@]/#/$built/examples/}" "$dist"
cp "$(find "$built/build" -name 'libmujoco.so.*' -size +1M | head -1)" "$dist"
strip "$dist"/test.* "${programs[@]/#/$dist/}"
for program in "$dist"/test.* "${programs[@]/#/$dist/}"; do
    if readelf -d "$program" | grep -E 'NEEDED.*lib(cu|nv)'; then
        echo "$program still needs a CUDA library to start" >&2
        exit 1
    fi
done
du -sh "$dist"/*

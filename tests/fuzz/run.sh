#!/usr/bin/env bash
# Fuzzes the readers of foreign files, one target after the other, on stable Rust and without cargo-fuzz.
#
#   tests/fuzz/run.sh [--seconds N] [TARGET ...]
#
# N is the time of each target (600 by default), TARGET a file of fuzz_targets/ (all by default). What was learned stays in
# corpus/TARGET, an input that a reader stumbles over in artifacts/TARGET, both beside this script;
# `tests/fuzz/run.sh --repeat FILE TARGET` runs one input again. Needs a C++ compiler, which libFuzzer is built with. Ends with
# status 1 when something was found.
set -euo pipefail
from="$PWD"
cd "$(dirname "$0")"

seconds=600 repeat=""
while [ $# -gt 0 ]; do
    case "$1" in
        --seconds) seconds="$2"; shift 2 ;;
        --repeat)
            repeat="$(cd "$from" && realpath -- "$2")"
            [ -f "$repeat" ] || { echo "no file $2" >&2; exit 2; }
            shift 2 ;;
        --*) echo "usage: tests/fuzz/run.sh [--seconds N] [--repeat FILE] [TARGET ...]" >&2; exit 2 ;;
        *) break ;;
    esac
done
if [ $# -eq 0 ]; then
    for file in fuzz_targets/*.rs; do set -- "$@" "$(basename "$file" .rs)"; done
fi

# What `cargo fuzz --sanitizer none` builds with. With a target named, build scripts and macros are built without it.
host="$(rustc -vV | sed -n 's/^host: //p')"
export RUSTFLAGS="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
-Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=1 --cfg fuzzing"
export CARGO_TARGET_DIR="$PWD/target"
# Every input writes files: where there is a file system in memory, there. Targets end without cleaning up.
memory=/dev/shm
[ -w "$memory" ] || memory="${TMPDIR:-/tmp}"
export TMPDIR="$(mktemp -d -p "$memory")"
trap 'rm -rf "$TMPDIR"' EXIT

for target in "$@"; do
    [ -f "fuzz_targets/$target.rs" ] || { echo "no target $target: $(ls fuzz_targets)" >&2; exit 2; }
    cargo build --quiet --release --locked --target "$host" --bin "$target"
done

found=0
for target in "$@"; do
    program="target/$host/release/$target"
    mkdir -p "corpus/$target" "artifacts/$target"
    # libFuzzer says which sanitizers it does not find: none is meant to be there.
    E2H_FUZZ_SEEDS="corpus/$target" "$program" > /dev/null 2> >(grep -v __sanitizer >&2)
    # Limits that are above what an honest reader of such small files takes, and far below a machine's memory.
    limits=(-rss_limit_mb=2048 -timeout=20 -max_len=131072 "-artifact_prefix=artifacts/$target/")
    if [ -n "$repeat" ]; then
        "$program" "${limits[@]}" "$repeat" || found=1
        continue
    fi
    echo "== $target, $seconds s"
    log="artifacts/$target/log"
    # One worker: its readers may use as many threads as they like.
    if ! "$program" "corpus/$target" "${limits[@]}" "-max_total_time=$seconds" -print_final_stats=1 -use_value_profile=1 \
        > "$log" 2>&1; then
        found=1
        grep -aE "^(a panic|a message|an allocation)|ERROR|Test unit written" "$log" || true
        echo "FOUND: $log has the story"
    fi
    grep -aE "^#[0-9]+.*cov:" "$log" | tail -n 1 || true
    grep -aE "number_of_executed_units|peak_rss_mb" "$log" || true
done
exit "$found"

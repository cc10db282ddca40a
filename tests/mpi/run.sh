#!/usr/bin/env bash
# A run of the smoke preset on several ranks: the bytes of a run on one, also where a rank was killed and fewer go on. A rank that is
# killed, panics, fails or is stuck ends all of them, with a status that is not 0.
#
#   tests/mpi/run.sh      E2H_MPI_INSTALL=1 installs Debian's packages first where they are missing
#
# Exit status: 0 everything holds, 1 something does not, 3 there is no MPI here, and nothing was run.
set -euo pipefail
root="$(cd "$(dirname "$0")/../.." && pwd)"
cd "$root"

packages="libopenmpi-dev openmpi-bin libclang-dev"
missing() {
    for program in mpicc mpirun; do command -v "$program" > /dev/null || echo "$program"; done
    [ -n "${LIBCLANG_PATH:-}" ] || [ -n "$(find /usr/lib /usr/lib64 -name 'libclang*.so*' 2> /dev/null | head -n 1)" ] || echo libclang
}
if [ -n "$(missing)" ] && [ -n "${E2H_MPI_INSTALL:-}" ] && [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
    echo "installing $packages"
    { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends $packages; } > /dev/null 2>&1 || true
fi
if [ -n "$(missing)" ]; then
    echo "NOT RUN: no $(missing | paste -sd, | sed 's/,/, no /g') to build the feature mpi with (Debian: $packages)"
    exit 3
fi

# Beside the usual build, whose crates it shares but for two; the programs of both are kept apart.
kept="$root/target/mpi"
built="${CARGO_TARGET_DIR:-$root/target}/release/examples"
mkdir -p "$kept"
clock=$SECONDS
cargo build --release --quiet --locked --workspace --example nut_assembly
cp "$built/nut_assembly" "$kept/alone"
cargo build --release --quiet --locked --workspace --features mpi --example nut_assembly --example ranks
cp "$built/nut_assembly" "$built/ranks" "$kept/"
cargo build --release --quiet --locked --workspace --example nut_assembly
cmp --silent "$built/nut_assembly" "$kept/alone"
echo "built in $((SECONDS - clock)) s"

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
mpirun=(mpirun --allow-run-as-root --oversubscribe --bind-to none --quiet -n)
ranks() { "${mpirun[@]}" "$@"; }
settings=(--preset smoke --seed 3 --threads 1 --quiet)
for value in env.horizon_hard=48 train.easy_steps=12 train.initial_steps=12 train.update_steps=12 train.save_every=4 \
    train.step.shards=4 loop.cycles=3 loop.loops=3; do
    settings+=(--set "$value")
done
fails() { echo "FAILED: $*"; exit 1; }

# All files that hold results and no times.
contents() {
    (cd "$1" && find . -type f \( -name '*.safetensors' -o -name '*.parquet' -o -name '*.svg' -o -name '*.png' -o -name '*.toml' \
        -o -name policy.json -o -name reversals.json \) -exec cksum {} + | sort -k 3)
}
same() {
    diff <(contents "$work/alone") <(contents "$work/$1") || fails "$2: other results than of a run alone"
    echo "ok: $2: the same bytes in $(contents "$work/$1" | wc -l) files"
}
# Runs the rest, which has to end by itself within $1 seconds, with a status that is not 0 and with $2 in what it says.
ends() {
    local begun=$SECONDS status=0
    timeout 60 env "${@:3}" > "$work/said" 2>&1 || status=$?
    local took=$((SECONDS - begun))
    [ "$status" != 0 ] && [ "$status" != 124 ] || { cat "$work/said"; fails "status $status after $took s: ${*:3}"; }
    [ "$took" -le "$1" ] || fails "$took s until the end, expected at most $1: ${*:3}"
    [ "$(grep -c -- "$2" "$work/said")" = 1 ] || { cat "$work/said"; fails "expected one line with '$2'"; }
    echo "ok: ended after $took s with status $status: $(grep -- "$2" "$work/said")"
}

echo "== sums do not depend on the number of ranks"
for n in 1 2 4; do ranks "$n" "$kept/ranks" 100000; done | tee "$work/sums"
[ "$(cut -d: -f 2 "$work/sums" | cut -d, -f 1 | sort -u | wc -l)" = 1 ] || fails "other sums"

echo "== a run on 1, 2 and 4 ranks"
"$kept/alone" "${settings[@]}" --out "$work/alone" > "$work/said" || { cat "$work/said"; exit 1; }
for n in 1 2 4; do
    ranks "$n" "$kept/nut_assembly" "${settings[@]}" --out "$work/$n" > "$work/said" 2>&1 || { cat "$work/said"; exit 1; }
    [ "$(grep -c report: "$work/said")" = 1 ] || fails "expected one report, found $(cat "$work/said")"
    same "$n" "$n ranks"
done

echo "== a rank of four is killed in a training; two go on, then one"
# $1 is where it is resumed, $2 and the rest resume it.
kill_and_resume() {
    ranks 4 "$kept/nut_assembly" "${settings[@]}" --out "$work/$1" > "$work/said" 2>&1 &
    local job=$! victim="" begun status=0
    until [ -e "$work/$1/iteration_00/policy/training.safetensors" ]; do
        kill -0 "$job" 2> /dev/null || { cat "$work/said"; fails "it ended before it could be killed"; }
        sleep 0.01
    done
    for process in $(pgrep -P "$job"; pgrep -P "$(pgrep -P "$job" -d ,)" 2> /dev/null || true); do
        if tr '\0' '\n' < "/proc/$process/environ" 2> /dev/null | grep -q '^OMPI_COMM_WORLD_RANK=2$'; then victim=$process; fi
    done
    [ -n "$victim" ] || fails "no rank 2 to kill"
    kill -KILL "$victim"
    begun=$SECONDS
    wait "$job" || status=$?
    [ "$status" != 0 ] || fails "a killed rank, and status 0"
    [ $((SECONDS - begun)) -le 10 ] || fails "$((SECONDS - begun)) s until the end"
    echo "ok: ended $((SECONDS - begun)) s after the kill with status $status"
    [ ! -e "$work/$1/iteration_00/record.json" ] || fails "it was killed too late"
    "${@:2}" --resume --out "$work/$1" > "$work/said" 2>&1 || { cat "$work/said"; exit 1; }
}
kill_and_resume killed ranks 2 "$kept/nut_assembly" "${settings[@]}"
same killed "killed on 4, resumed on 2"
kill_and_resume again "$kept/alone" "${settings[@]}"
same again "killed on 4, resumed without MPI"

echo "== what goes wrong on one rank ends all"
ends 10 "rank 1: panicked" "${mpirun[@]}" 2 "$kept/ranks" 1000 panic
ends 10 "it failed, as asked" "${mpirun[@]}" 2 "$kept/ranks" 1000 fail
ends 13 "another rank has not come in 3 s" E2H_MPI_WAIT=3 "${mpirun[@]}" 2 "$kept/ranks" 1000 stuck

echo "== what cannot begin says what to do"
ends 10 "exists: give --resume" "${mpirun[@]}" 2 "$kept/nut_assembly" "${settings[@]}" --out "$work/alone"
ends 10 "expected a multiple of the 3 ranks, got 4" "${mpirun[@]}" 3 "$kept/nut_assembly" "${settings[@]}" --out "$work/three"
ends 10 "--features mpi" "${mpirun[@]}" 2 "$kept/alone" "${settings[@]}" --out "$work/unbuilt"
ends 10 "unexpected argument" "${mpirun[@]}" 2 "$kept/nut_assembly" --nonsense
ends 10 "E2H_MPI_WAIT: expected a number of seconds" E2H_MPI_WAIT=soon "${mpirun[@]}" 2 "$kept/nut_assembly" "${settings[@]}" --out "$work/wait"

echo "all checks with MPI hold, in $((SECONDS - clock)) s"

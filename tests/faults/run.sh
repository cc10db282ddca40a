#!/usr/bin/env bash
# A run is killed, its disk fails, its files are damaged, and two processes work in it at once. Whatever happens, it ends with the
# bytes of an undisturbed run or with a refusal that names the file, and nothing is left over.
#
#   tests/faults/run.sh [sample | full] [SEED] [FAULT ...]      prints a table of counts; status 1 where anything else happened
#
# FAULT is kills, operations, damage or pairs, by default all of them.
# The sample takes one to two minutes of processor time, everything about twenty. E2H_FAULTS_SET has further values of the
# configuration ("loop.cycles=3 ...").
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
how="${1:-sample}"
RANDOM="${2:-1}"
case "$how" in
    sample) kills=8 every=40 errnos=(28) damaged=12 pairs=1 ;;
    full) kills=200 every=10 errnos=(28 5) damaged=60 pairs=20 ;;
    *) echo "expected sample or full, got $how" >&2; exit 2 ;;
esac

wanted=" ${*:3} "
[ $# -ge 3 ] || wanted=" kills operations damage pairs "

cd "$root"
if [ -z "${E2H_FAULTS_PROGRAM:-}" ]; then
    cargo build --release --quiet --locked --workspace --example nut_assembly
fi
program="${E2H_FAULTS_PROGRAM:-${CARGO_TARGET_DIR:-$root/target}/release/examples/nut_assembly}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
library="$work/fault.so"
cc -shared -fPIC -O1 -Wall -Wextra -Werror -o "$library" "$here/fault.c" -ldl

# The smallest run that does every stage for real: it accepts a reversal, trains the critic, updates, and saves training states.
smallest="train.step.noises=1 train.easy_steps=400 train.initial_steps=250 train.update_steps=25 train.save_every=20
    loop.cycles=2 loop.loops=2 policy.cameras=[]"
settings=(--preset smoke --seed 0 --threads 1 --quiet)
for value in $smallest ${E2H_FAULTS_SET:-}; do settings+=(--set "$value"); done
# Runs the program in folder $1 with further arguments; what it says is in $1.out.
e2h() { "$program" "${settings[@]}" --out "$1/run" "${@:2}" > "$1.out" 2>&1; }
# What variables of fault.c precede.
faulty() { env "FAULT_ROOT=$1/run" "LD_PRELOAD=$library" "${@:2}"; }
# Goes on where a run is; where there is none yet, begins.
again() { if [ -e "$1/run/run.json" ]; then e2h "$1" --resume; else e2h "$1"; fi; }
# Sets `drawn`, below $1. A subshell would draw from a stream of its own.
draw() { drawn=$(((RANDOM << 15 | RANDOM) % $1)); }

# Every file of a run and a checksum of it, without the times that it took and the machine's name.
clocks='/"stage_minutes": \{$/,/\}/d; s/"(minutes|seconds|machine|sha256)": [^{}]*//'
contents() {
    (cd "$1/run" && find . -type f | sort | while read -r file; do
        case "$file" in
            # Made of what the others hold, with times in the middle of pictures, or checksums of files that hold times.
            ./report.html | ./run.lock | */files.json) sum=- ;;
            *.json) sum="$(sed -E "$clocks" "$file" | cksum)" ;;
            *) sum="$(cksum < "$file")" ;;
        esac
        echo "$file $sum"
    done)
}
# What is in the folder of the case beside its run, and in the run beside what belongs there.
leftovers() {
    ls -A "$1" | grep -vx run || true
    comm -13 <(cut -d ' ' -f 1 "$work/expected" | sort) <(cd "$1/run" && find . -type f | sort)
}

declare -A count
findings=()
kind=
# $1: same, refused or the finding; $2: what it is about.
note() {
    count[$kind, $1]=$((${count[$kind, $1]:-0} + 1))
    case "$1" in same | refused) ;; *) findings+=("$kind: $1: $2") ;; esac
}
# The case in folder $1 has ended well: is all as in the undisturbed run? $2: what was done to it.
judge() {
    local left
    left="$(leftovers "$1")"
    if [ -n "$left" ]; then
        note leftover "$2: $(tr '\n' ' ' <<< "$left")"
    elif contents "$1" | cmp --silent - "$work/expected"; then
        note same "$2"
    else
        note unnoticed "$2, other bytes in $(contents "$1" | comm -13 "$work/expected" - | cut -d ' ' -f 1 | head -n 3 | tr '\n' ' ')"
    fi
}
last_words() { tail -n 1 "$1.out" | cut -c 1-200; }
table() {
    echo
    echo "| fault | cases | runs with the same bytes in the end | refused, with the file's name | not noticed | refused without a name | not to be resumed | left over |"
    echo "|---|---|---|---|---|---|---|---|"
    for line in "kills:killed at a drawn instant, several times a run" "operations:a file operation fails, then \`--resume\`" "damage:a damaged file, then \`--resume\`" "pairs:two processes at once"; do
        k="${line%%:*}"
        [ "${count[$k, cases]:-0}" -gt 0 ] || continue
        echo "| ${line#*:} | ${count[$k, cases]:-0} | ${count[$k, same]:-0} | ${count[$k, refused]:-0} | ${count[$k, unnoticed]:-0} | ${count[$k, unnamed]:-0} | ${count[$k, refusal]:-0} | ${count[$k, leftover]:-0} |"
    done
    if [ ${#findings[@]} -gt 0 ]; then
        echo
        printf -- '- %s\n' "${findings[@]}" | sed "s#$work/##g"
    fi
}

folder() { rm -rf "$work/case" "$work/case.out"; mkdir "$work/case"; }
case="$work/case"

mkdir "$work/whole"
log="$work/log"
TIMEFORMAT='%U %S'
seconds="$({ time faulty "$work/whole" "FAULT_LOG=$log" "$program" "${settings[@]}" --out "$work/whole/run" > "$work/whole.out" 2>&1; } 2>&1)" \
    || { cat "$work/whole.out"; exit 1; }
contents "$work/whole" > "$work/expected"
if ! grep -q '"critic_loss": [0-9]' "$work/whole/run/results.json" || ! grep -q '"accepted": [1-9]' "$work/whole/run/results.json" \
    || grep -q '"skipped": true' "$work/whole/run/results.json"; then
    echo "the run that is to be disturbed leaves stages out" >&2
    exit 1
fi
operations="$(sed -n 's/^operations //p' "$log")"
total="$(awk '{ print int(1000 * ($1 + $2)) }' <<< "$seconds")"
echo "one run: $total ms of processor time, $operations file operations" >&2

kind=kills
count[kills, cases]=0
folder
while [ "${count[kills, cases]}" -lt "$kills" ]; do
    [[ "$wanted" == *" $kind "* ]] || break
    draw "$total"
    ms=$((20 + drawn))
    how_to=()
    [ -e "$case/run/run.json" ] && how_to=(--resume)
    status=0
    faulty "$case" "FAULT_CPU_MS=$ms" "$program" "${settings[@]}" --out "$case/run" "${how_to[@]}" > "$case.out" 2>&1 || status=$?
    case "$status" in
        155) count[kills, cases]=$((${count[kills, cases]} + 1)) ;; # 128 + SIGPROF
        0) ;;
        *) count[kills, cases]=$((${count[kills, cases]} + 1)); note refusal "after a kill: $(last_words "$case")"; folder; continue ;;
    esac
    # A run that has ended, or that was the last one killed, is judged; its kills count with it.
    if [ "$status" = 0 ] || [ "${count[kills, cases]}" -ge "$kills" ]; then
        if [ "$status" = 0 ] || again "$case"; then judge "$case" "killed at $ms ms"; else note refusal "after a kill: $(last_words "$case")"; fi
        folder
    fi
done

kind=operations
for errno in "${errnos[@]}"; do
    [[ "$wanted" == *" $kind "* ]] || break
    for ((at = every; at <= operations; at += every)); do
        folder
        count[$kind, cases]=$((${count[$kind, cases]:-0} + 1))
        status=0
        faulty "$case" "FAULT_AT=$at" "FAULT_ERRNO=$errno" "FAULT_LOG=$log" "$program" "${settings[@]}" --out "$case/run" > "$case.out" 2>&1 || status=$?
        failed="$(head -n 1 "$log")"
        if [ "$status" != 0 ]; then
            # The file itself, or where it was to lie: the one that is written is beside it, under another name.
            if ! grep -qF "$(dirname "${failed#* }")" "$case.out"; then
                note unnamed "$failed, errno $errno: $(last_words "$case")"
                continue
            fi
            note refused "$failed"
        fi
        if again "$case"; then judge "$case" "$failed, errno $errno"; else note refusal "after $failed, errno $errno: $(last_words "$case")"; fi
    done
done

# A whole run, one whose last stage is to do, and one that stands at its beginning.
kind=damage
part() {
    rm -rf "$work/$1"
    cp -r "$work/whole" "$work/$1"
    rm -rf "$work/$1"/run/{results.json,report.html}
    for path in "${@:2}"; do rm -rf "$work/$1/run/$path"; done
}
part middle iteration_01/{record.json,policy,rollouts.png}
part start iteration_00 iteration_01
for ((i = 0; i < damaged; i++)); do
    [[ "$wanted" == *" $kind "* ]] || break
    folder
    count[$kind, cases]=$((${count[$kind, cases]:-0} + 1))
    from=(whole middle start)
    from="${from[i % 3]}"
    rm -rf "$case"
    cp -r "$work/$from" "$case"
    mapfile -t files < <(cd "$case/run" && find . -type f -size +0 ! -name run.lock | sort)
    draw ${#files[@]}
    file="${files[drawn]}"
    length="$(stat -c %s "$case/run/$file")"
    draw "$length"
    at="$drawn"
    if [ $((i % 4)) = 3 ]; then
        truncate -s "$at" "$case/run/$file"
        what="$file of a run ($from), cut to $at of $length bytes"
    else
        byte="$(od -An -tu1 -j "$at" -N 1 "$case/run/$file")"
        byte=$((byte ^ 1 << RANDOM % 8))
        printf "\\x$(printf %x "$byte")" | dd of="$case/run/$file" bs=1 seek="$at" conv=notrunc status=none
        what="$file of a run ($from), a bit of byte $at of $length"
    fi
    if e2h "$case" --resume; then
        judge "$case" "$what"
    elif grep -qF "run/${file#./}" "$case.out" || grep -qF "run: ${file#./}: " "$case.out" || grep -qF "run/$(dirname "${file#./}"): " "$case.out"; then
        note refused "$what"
    else
        note unnamed "$what: $(last_words "$case")"
    fi
done

kind=pairs
for ((i = 0; i < pairs; i++)); do
    [[ "$wanted" == *" $kind "* ]] || break
    folder
    count[$kind, cases]=$((${count[$kind, cases]:-0} + 1))
    first=0 second=0
    "$program" "${settings[@]}" --out "$case/run" > "$work/first" 2>&1 &
    other=$!
    draw 30
    sleep "0.$(printf %02d "$drawn")"
    "$program" "${settings[@]}" --out "$case/run" --resume > "$work/second" 2>&1 || second=$?
    wait "$other" || first=$?
    if [ "$first" != 0 ] && [ "$second" != 0 ]; then
        note refusal "both: $(tail -n 1 "$work/first" | cut -c 1-200)"
        continue
    fi
    unnamed=
    for which in first second; do
        if [ "${!which}" != 0 ]; then
            if grep -qF "$case/run" "$work/$which"; then note refused ""; else unnamed="$(tail -n 1 "$work/$which" | cut -c 1-200)"; fi
        fi
    done
    if [ -n "$unnamed" ]; then note unnamed "$unnamed"; else judge "$case" "two processes"; fi
done

table
if [ ${#findings[@]} -gt 0 ]; then exit 1; fi

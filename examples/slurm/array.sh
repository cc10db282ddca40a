#!/usr/bin/env bash
# Seeds and pairs side by side: every task of an array does a part of a comparison's runs, on a machine of its own. No MPI.
#
#   job=$(sbatch --parsable --array=1-8 examples/slurm/array.sh --tasks cube_pick_place,disk --seeds 0,1,2,3 --out runs/compare)
#   sbatch --dependency=afterany:$job examples/slurm/array.sh --merge --tasks cube_pick_place,disk --seeds 0,1,2,3 --out runs/compare
#
# All arguments go to the example `compare` (E2H_PROGRAMS says where it is). Task i of n does `--shard i/n`; runs take as long as each
# other, so a number of tasks that divides the number of runs wastes nothing. A task that is started again goes on where it was. The
# folder of `--out` has to be on a disk that all machines share. Without an array the arguments are taken as they are.
#SBATCH --job-name=e2h-array
#SBATCH --ntasks=1
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@120
set -uo pipefail

program="${E2H_PROGRAMS:-target/release/examples}/compare"
[ -x "$program" ] || { echo "expected a program, found nothing at $program" >&2; exit 2; }
part=()
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
    if [ "${SLURM_ARRAY_TASK_MIN:-1}" != 1 ] || [ "${SLURM_ARRAY_TASK_MAX:-1}" != "${SLURM_ARRAY_TASK_COUNT:-1}" ]; then
        echo "expected --array=1-N, found tasks $SLURM_ARRAY_TASK_MIN to $SLURM_ARRAY_TASK_MAX" >&2
        exit 2
    fi
    part=(--shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT")
fi
# As many runs side by side as the task has cores.
"$program" "$@" "${part[@]}" --jobs "${SLURM_CPUS_PER_TASK:-${SLURM_CPUS_ON_NODE:-1}}" &
running=$!
stopped=""
trap 'stopped=yes; kill -TERM "$running" 2> /dev/null' TERM
status=0
wait "$running" || status=$?
while [ -n "$stopped" ] && kill -0 "$running" 2> /dev/null; do
    status=0
    wait "$running" || status=$?
done
# Stopped before the time was over: all is saved, and the next try goes on.
if [ -n "$stopped" ] && [ "$status" -ge 128 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt "${E2H_RESTARTS:-10}" ]; then
    scontrol requeue "$SLURM_JOB_ID"
    sleep 60
fi
exit "$status"

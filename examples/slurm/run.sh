#!/usr/bin/env bash
# One run on several nodes, with SLURM. After a lost rank or node, and shortly before the time limit, it goes back into the queue and
# goes on from its last saved state, on as many ranks as there are then.
#
#   sbatch --nodes=4 --time=12:00:00 examples/slurm/run.sh nut_assembly --preset paper --seed 0 --out runs/paper-0 \
#       --set train.step.shards=8
#
# The first argument is an example built on the cluster, with its MPI: cargo build --release --features mpi --examples
# (E2H_PROGRAMS says where they are), the others are its command line. `--out` has to be on a disk that rank 0 reaches from every node;
# --resume is added. The number of nodes has to divide train.step.shards. E2H_MPI_KIND is what `srun --mpi` is given (pmix),
# E2H_RESTARTS how often the job goes back into the queue (10).
#SBATCH --job-name=e2h
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@120
set -uo pipefail

program="${E2H_PROGRAMS:-target/release/examples}/${1:?expected the name of an example, found nothing}"
shift
out=""
for ((i = 1; i <= $#; i++)); do
    case "${!i}" in
        --out) next=$((i + 1)) && out="${!next:-}" ;;
        --out=*) out="${!i#--out=}" ;;
    esac
done
[ -n "$out" ] || { echo "expected --out DIR, found none: a job that starts again has to find its run" >&2; exit 2; }
[ -x "$program" ] || { echo "expected a program, found nothing at $program" >&2; exit 2; }
# An empty folder is a run that has not begun: --resume begins it.
mkdir -p "$out"

tries="${SLURM_RESTART_COUNT:-0}"
again() {
    if [ "$tries" -ge "${E2H_RESTARTS:-10}" ]; then
        echo "$1; not started again after $tries restarts (E2H_RESTARTS)"
        exit 1
    fi
    echo "$1; back into the queue"
    # Ends this script, too.
    scontrol requeue "$SLURM_JOB_ID"
    sleep 60
}

# One rank a node, with all its cores: threads share a node, ranks do not.
srun --mpi="${E2H_MPI_KIND:-pmix}" --kill-on-bad-exit=1 --cpu-bind=none "$program" "$@" --resume &
step=$!
stopped=""
# From SLURM, before the time is over: rank 0 saves and says so with status 143.
trap 'stopped=yes; kill -TERM "$step" 2> /dev/null' TERM
status=0
wait "$step" || status=$?
while [ -n "$stopped" ] && kill -0 "$step" 2> /dev/null; do
    status=0
    wait "$step" || status=$?
done

case "$status" in
    0) echo "done" ;;
    # What would happen again: an error that the program has explained, a wrong command line, a bug.
    1 | 2 | 101) exit "$status" ;;
    *) again "ended with status $status" ;;
esac

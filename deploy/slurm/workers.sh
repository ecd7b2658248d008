#!/bin/bash
# Workers as an array job, each on the cores that it was given:
#   sbatch --array 1-20 --cpus-per-task 8 --time 4:00:00 deploy/slurm/workers.sh --run night
# A join file that the nodes can read is named by DREAMFLEET_JOIN (docs/how-to/security.md), as in every shell.
#SBATCH --job-name=dreamfleet
#SBATCH --output=dreamfleet-%A-%a.log
#SBATCH --requeue
#SBATCH --signal=B:TERM@60
set -eu

# Leave by itself a minute and a half before the limit: what runs is finished, and nothing is scored in vain.
lifetime=()
if [[ -n ${SLURM_JOB_END_TIME:-} ]]; then
    left=$((SLURM_JOB_END_TIME - $(date +%s) - 90))
    lifetime=(--lifetime "$((left > 1 ? left : 1))")
fi

# Slurm tells this shell alone (B:). Bash waits for what runs in front before it hears; so the worker runs behind.
dreamfleet worker --name "${SLURMD_NODENAME:-$(hostname -s)}-${SLURM_ARRAY_TASK_ID:-0}" \
    --slots "${SLURM_CPUS_PER_TASK:-0}" "${lifetime[@]}" "$@" &
worker=$!
trap 'kill -TERM "$worker" 2>/dev/null || true' TERM INT
code=0
wait "$worker" || code=$?
while kill -0 "$worker" 2>/dev/null; do # the wait was cut short by a signal: the worker drains
    code=0
    wait "$worker" || code=$?
done
exit "$code"

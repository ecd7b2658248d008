#!/bin/sh
# Begin a run, or go on with it where its journal lies already: one command for every start of a container or a unit.
#   begin.sh RUN [FLAGS OF A NEW RUN ...]
set -eu
run=$1
shift
if [ -e "${DREAMFLEET_RUNS_DIR:-runs}/$run/journal.sqlite" ]; then
    exec dreamfleet coordinator --resume "$run"
fi
exec dreamfleet coordinator --run "$run" "$@"

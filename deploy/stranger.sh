#!/usr/bin/env bash
# `make demo` and `make test` as a stranger runs them: a fresh clone, no environment, an empty home. Prints the exit
# code, the time and what the environment weighs; 1 if either fails. DIRECTORY keeps the clone and the logs there.
set -uo pipefail
source=$(git rev-parse --show-toplevel)
folder=${DIRECTORY:-$(mktemp -d)}
mkdir -p "$folder/home"
git clone --quiet "$source" "$folder/dreamfleet" || exit 1  # not into what another run left
failed=0
for target in ${TARGETS:-demo test}; do
    began=$(date +%s)
    env -i HOME="$folder/home" PATH=/usr/local/bin:/usr/bin:/bin \
        make --directory "$folder/dreamfleet" "$target" > "$folder/$target.log" 2>&1
    code=$?
    [ $code -eq 0 ] || failed=1
    echo "make $target: exit $code in $(($(date +%s) - began)) s; .venv $(du -sm "$folder/dreamfleet/.venv" | cut -f1) MB;" \
        "$(tail -n 1 "$folder/$target.log")"
done
if [ $failed -eq 0 ] && [ -z "${DIRECTORY:-}" ]; then rm -rf "$folder"; else echo "logs and clone: $folder"; fi
exit $failed

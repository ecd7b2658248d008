#!/usr/bin/env bash
# Print the newest CPython from 3.12 to 3.13 that this machine has, on PATH or by pyenv; nothing where it has none.
# Those are the versions, besides 3.11, for which every package of the tests has a wheel. `all`: each from 3.11 to 3.14.
folder=$(pyenv root 2> /dev/null || echo "$HOME/.pyenv")
for version in ${1:+3.14} 3.13 3.12 ${1:+3.11}; do
    for python in "python$version" "$folder"/versions/"$version".*/bin/python3; do
        if "$python" -c "import sys; sys.exit(f'{sys.version_info[0]}.{sys.version_info[1]}' != '$version')" 2> /dev/null; then
            command -v "$python"
            [ -n "${1:-}" ] || exit 0
            break
        fi
    done
done

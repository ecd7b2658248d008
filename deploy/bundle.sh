#!/usr/bin/env bash
# A world model from nothing. `bundle.sh FOLDER` trains on random drives, ROUNDS=2 then on drives of means that evolved
# on that model too, their failures included. Amounts come from the environment.
set -euo pipefail
data=${1:?usage: bundle.sh FOLDER}
dreamfleet=${DREAMFLEET:-dreamfleet}
generations=${GENERATIONS:-32} drives=${DRIVES:-25} endpoint=${ENDPOINT:-tcp/127.0.0.1:7449}

train() {
  "$dreamfleet" train vae --data "$data" ${VAE_FLAGS:-}
  "$dreamfleet" encode --data "$data"
  "$dreamfleet" train mdnrnn --data "$data" ${RNN_FLAGS:-}
  "$dreamfleet" bundle --data "$data" --out "$1"
}

"$dreamfleet" collect --data "$data" ${COLLECT_FLAGS:-}
train "$data/first.zip"
if [ "${ROUNDS:-1}" -lt 2 ]; then
  mv "$data/first.zip" "$data/tiny.zip"
  exit
fi

"$dreamfleet" coordinator --preset dream --bundle "$data/first.zip" --run collected --runs-dir "$data/runs" \
  --listen "$endpoint" --generations "$generations" --collect-every 2 --collect-episodes "$drives" ${RUN_FLAGS:-} &
coordinator=$!
trap 'kill "$coordinator" 2>/dev/null || true' EXIT
"$dreamfleet" worker --connect "$endpoint" --run collected --exit-when-done
wait "$coordinator"

"$dreamfleet" collect --data "$data" --from-run collected --runs-dir "$data/runs"
rm -f "$data"/vae*.safetensors "$data"/mdnrnn*.safetensors
train "$data/tiny.zip"

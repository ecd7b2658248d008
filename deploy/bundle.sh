#!/usr/bin/env bash
# A world model from nothing. `bundle.sh FOLDER` trains on random drives. ROUNDS=2 then doubles these, adds some drives
# of means that evolved in that model's dream, their failures included, and goes on with decoder and MDN-RNN; the encoder
# stays, so that what was evolved on the first model fits the second. Amounts come from the environment.
set -euo pipefail
data=${1:?usage: bundle.sh FOLDER}
dreamfleet=${DREAMFLEET:-dreamfleet}
endpoint=${ENDPOINT:-tcp/127.0.0.1:7449}

"$dreamfleet" collect --data "$data" ${COLLECT_FLAGS:-}
"$dreamfleet" train vae --data "$data" ${VAE_FLAGS:-}
"$dreamfleet" encode --data "$data"
"$dreamfleet" train mdnrnn --data "$data" ${RNN_FLAGS:-}
"$dreamfleet" bundle --data "$data" --out "$data/first.zip"
if [ "${ROUNDS:-1}" -lt 2 ]; then
  mv "$data/first.zip" "$data/tiny.zip"
  exit
fi

"$dreamfleet" collect --data "$data" ${MORE_COLLECT_FLAGS:---episodes 1200}
"$dreamfleet" coordinator --preset dream --bundle "$data/first.zip" --run collected --runs-dir "$data/runs" \
  --listen "$endpoint" ${RUN_FLAGS:---generations 32 --collect-every 2 --collect-episodes 5} &
coordinator=$!
trap 'kill "$coordinator" 2>/dev/null || true' EXIT
"$dreamfleet" worker --connect "$endpoint" --run collected --exit-when-done
wait "$coordinator"
"$dreamfleet" collect --data "$data" --from-run collected --runs-dir "$data/runs"

"$dreamfleet" train vae --data "$data" --decoder-only ${MORE_VAE_FLAGS:---updates 3300}
"$dreamfleet" encode --data "$data"
"$dreamfleet" train mdnrnn --data "$data" ${MORE_RNN_FLAGS:---updates 1400}
"$dreamfleet" bundle --data "$data" --out "$data/tiny.zip"

#!/bin/sh
# A shell script on the companion computer: sets a parameter, such as the number of battery cells, unless it has the value.
#
#     sh examples/companion/check.sh http://127.0.0.1:8765 BAT1_N_CELLS 6
#
# It needs curl. If the service requires a token, it is in the environment variable PARAMCLIENT_TOKEN. curl receives it
# through a pipe, because every user can read the arguments of a process.
set -eu

service=${1:-http://127.0.0.1:8765}
name=${2:-BAT1_N_CELLS}
wanted=${3:-6}
parameter="$service/api/vehicles/1/1/params/$name"

ask() {
    if [ -n "${PARAMCLIENT_TOKEN:-}" ]; then
        printf 'header = "Authorization: Bearer %s"\n' "$PARAMCLIENT_TOKEN"
    fi | curl --silent --show-error --fail-with-body --config - --header 'Content-Type: application/json' "$@"
}

# the number in {"name":"BAT1_N_CELLS","value":4,…
value_of() {
    sed 's/.*"value":\([^,}]*\).*/\1/'
}

# the service listens before it has heard the vehicle
until ask "$service/api/vehicles/1/1/params?names=$name" > /dev/null 2>&1; do
    sleep 0.2
done
now=$(ask "$parameter?live=true" | value_of)
echo "$name = $now"
if [ "$now" != "$wanted" ]; then
    ask --request PUT --data "{\"value\":$wanted}" "$parameter" > /dev/null
    echo "$name = $(ask "$parameter" | value_of), was $now"
fi

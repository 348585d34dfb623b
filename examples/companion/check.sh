#!/bin/sh
# A shell script on the companion computer: is the battery set up as this vehicle needs it? If not, it is set.
#
#     sh check.sh http://127.0.0.1:8765 BAT1_N_CELLS 6
#
# It needs curl. The token, where the service wants one, stands in the environment variable PARAMCLIENT_TOKEN; curl
# gets it by a pipe, as anybody may read the arguments of a process.
set -eu

service=${1:-http://127.0.0.1:8765}
name=${2:-BAT1_N_CELLS}
wanted=${3:-6}
parameter="$service/api/v1/components/1/1/params/$name"

ask() {
    if [ -n "${PARAMCLIENT_TOKEN:-}" ]; then
        printf 'header = "Authorization: Bearer %s"\n' "$PARAMCLIENT_TOKEN"
    fi | curl --silent --show-error --fail-with-body --config - --header 'Content-Type: application/json' "$@"
}

# the number in {"name":"BAT1_N_CELLS","value":4,…
value_of() {
    sed 's/.*"value":\([^,}]*\).*/\1/'
}

# the service begins to listen before it has heard the vehicle
until ask "$service/api/v1/components/1/1" > /dev/null 2>&1; do
    sleep 0.2
done
now=$(ask --data '{}' "$parameter/read" | value_of)
echo "$name = $now"
if [ "$now" != "$wanted" ]; then
    ask --request PUT --data "{\"value\":$wanted}" "$parameter" > /dev/null
    echo "$name = $(ask "$parameter" | value_of), was $now"
fi

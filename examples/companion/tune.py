"""A program on the companion computer: sets a parameter over the HTTP API of the service.

    python examples/companion/tune.py http://127.0.0.1:8765 MC_ROLL_P 6.5

If the service requires a token, it is in the environment variable PARAMCLIENT_TOKEN.
"""

import json
import os
import sys
import time
import urllib.error
import urllib.request
from typing import Any

VEHICLE = "/api/vehicles/1/1"


def ask(address: str, body: dict[str, Any] | None = None, method: str | None = None) -> Any:
    """Send a request, and return the JSON of the response."""
    request = urllib.request.Request(
        address, None if body is None else json.dumps(body).encode(), method=method
    )
    request.add_header("Content-Type", "application/json")
    if token := os.environ.get("PARAMCLIENT_TOKEN"):
        request.add_header("Authorization", f"Bearer {token}")
    with urllib.request.urlopen(request, timeout=30) as response:
        return json.load(response)


def main(service: str, name: str, value: float) -> None:
    while True:
        try:
            ask(f"{service}{VEHICLE}/params?names={name}")
            break
        except urllib.error.URLError:  # the service listens before it has heard the vehicle
            time.sleep(0.2)
    done = ask(f"{service}{VEHICLE}/params/{name}", {"value": value}, "PUT")
    print(f"{done['status']}: {name} = {done['actual']!r}")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))

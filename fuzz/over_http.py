"""Random requests to a service, built from its OpenAPI document: `python -m fuzz.over_http --seconds 1200`.

Starts a service with a simulated PX4 and a new cache on loopback. Schemathesis sends valid and invalid
requests, and checks every response against the document: no 500, and no status, content type or schema that
is not in it. The document has 503 and 504: a vehicle need not answer within a nanosecond. The exit code is
that of schemathesis: 0 if nothing was found.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path
from typing import Final

__all__ = ["main"]

CHECKS: Final = (
    *("not_a_server_error", "status_code_conformance", "content_type_conformance"),
    *("response_headers_conformance", "response_schema_conformance"),
)
CONFIG: Final = """
[parameters]
"path.system" = 1
"path.component" = 1
"path.name" = "MC_ROLL_P"
"path.key" = "uid:4954414c44494e4f/1"

[checks]
not_a_server_error.expected-statuses = ["2xx", "3xx", "4xx", 503, 504]
"""
"""The configuration of schemathesis: requests use the simulated vehicle, because most others end with 404."""
LEFT_OUT: Final = (
    "/api/v1/events",
    "/api/v1/find",
    "/api/v1/components/{system}/{component}/successor",
    "/api/v1/components/{system}/{component}/reboot",
)
"""Operations that are left out: a stream does not end, a wait takes its whole timeout, a reboot takes
seconds."""
WORKERS: Final = 4


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="fuzz.over_http", description="Send requests at random to a service."
    )
    parser.add_argument("--seconds", type=int, default=1200, help="duration in seconds; default 1200")
    arguments, options = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (folder / "log").open("wb") as log:
            command = [sys.executable, "-m", "paramclient", "serve", "sim:px4", "--listen", "127.0.0.1:0"]
            service = subprocess.Popen(
                [*command, "--cache", str(folder / "cache.sqlite3")], stdout=subprocess.PIPE, stderr=log
            )
        try:
            assert service.stdout is not None
            url = service.stdout.readline().decode().split()[-1]
            find(url)
            (folder / "schemathesis.toml").write_text(CONFIG)
            fuzz = [str(Path(sys.executable).with_name("schemathesis"))]
            fuzz += ["--config-file", str(folder / "schemathesis.toml"), "run", f"{url}/openapi.json"]
            fuzz += ["--max-time", str(arguments.seconds), "--checks", ",".join(CHECKS), "--mode", "all"]
            fuzz += [f"--exclude-path={path}" for path in LEFT_OUT]
            fuzz += [f"--workers={WORKERS}", "--request-timeout=60", "--continue-on-failure", *options]
            code = subprocess.run(fuzz, check=False, env={**os.environ, "HOME": name}).returncode
            if service.poll() is not None:
                sys.stdout.write(f"the service has ended with {service.returncode}\n")
                code = 1
        finally:
            service.terminate()
            service.wait()
        said = (folder / "log").read_text(errors="replace")
        sys.stdout.write(said[-20_000:])
    return code or int("Traceback" in said)


def find(url: str) -> None:
    """Wait until the service has all parameters of the vehicle."""
    for path in ("/api/v1/find", "/api/v1/components/1/1/fetch"):
        body = json.dumps({"timeout_s": 60}).encode()
        request = urllib.request.Request(url + path, body, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request) as answer:
            assert answer.status == 200


if __name__ == "__main__":
    sys.exit(main())

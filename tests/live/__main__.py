"""Check the client on any vehicle by its link, put back what was changed, and print what was measured.

    python -m tests.live LINK [--kind px4|ardupilot] [--system N] [--only TEXT] [--read-only]
                              [--second-link LINK] [--reboot]

`make live LINK=udpin:127.0.0.1:14550` calls it. It is no part of the tests: it needs a vehicle.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import anyio
import anyio.lowlevel

from paramclient import ParamClient
from paramclient.errors import LinkError, NoReply, ParamClientError, UsageError, VehicleArmed
from tests.live.checks import Check, CheckFailed, Session, Skip, checks
from tests.live.choice import choose
from tests.live.journal import Journal, check_disarmed
from tests.live.relay import CLEAN, Relay

SEARCH_TIMEOUT: Final = 20.0
"""Seconds to wait for the first heartbeat."""
LISTENING_TIME: Final = 1.2
"""Seconds to listen for a second vehicle: each sends a heartbeat once a second."""
CHECK_TIMEOUT: Final = 300.0
"""Seconds after which a check counts as endless."""
PUT_BACK_TIMEOUT: Final = 120.0
"""Seconds for putting back and for the comparison with the state before."""

OK, SKIPPED, FAILED = "ok", "skipped", "FAILED"


class Row(NamedTuple):
    """One line of the table: the check, what was measured or went wrong, the promise, and the result."""

    name: str
    measured: str
    promise: str
    result: str


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Give the lines of a Markdown table."""
    head = Row("check", "measured", "the documentation promises", "result")
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, Row(*("-" * width for width in widths)), *rows):
        yield f"| {' | '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the suite; the exit code is 0, 1 when a check failed, 2 when it could not begin."""
    description = (__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m tests.live", description=description)
    parser.add_argument("link", help="the link to the vehicle, as in make live LINK=udpin:127.0.0.1:14550")
    parser.add_argument("--kind", choices=["px4", "ardupilot"], help="the autopilot that is expected")
    parser.add_argument("--system", type=int, help="the vehicle's system id, where several are on the link")
    parser.add_argument("--only", default="", metavar="TEXT", help="the checks whose name holds this text")
    parser.add_argument("--read-only", action="store_true", help="change nothing on the vehicle")
    parser.add_argument("--second-link", metavar="LINK", help="another link to the same vehicle")
    parser.add_argument("--reboot", action="store_true", help="restart the vehicle too")
    options = parser.parse_args(arguments)
    folder = Path(tempfile.mkdtemp(prefix="paramclient-live-"))
    try:
        with Relay(options.link) as relay:
            return anyio.run(_Run(options, relay, folder).run)
    except (UsageError, LinkError, NoReply, VehicleArmed) as error:
        print(f"{error}. Nothing was changed.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return 1
    finally:
        if not (folder / "keep").exists():  # it is there while the state before was not put back
            shutil.rmtree(folder)


class _Run:
    """One run of the suite."""

    def __init__(self, options: argparse.Namespace, relay: Relay, folder: Path) -> None:
        self._options = options
        self._relay = relay
        self._folder = folder
        self._rows: list[Row] = []
        self._is_interrupted = False

    async def run(self) -> int:
        """Look at the vehicle, make the checks, put back, print the table; the exit code."""
        session = await self._begin()
        began = time.monotonic()
        async with anyio.create_task_group() as tasks:
            scope = anyio.CancelScope()
            tasks.start_soon(self._stop_on_signals, scope)
            try:
                with scope:
                    for check in checks(reboots=self._options.reboot):
                        await anyio.lowlevel.checkpoint()  # a signal counts, also when a check fails at once
                        if self._options.only in check.name:
                            await self._make(check, session)
            finally:
                with anyio.CancelScope(shield=True):
                    await self._end(session)
            tasks.cancel_scope.cancel()
        print("", *table(self._rows), sep="\n")
        counts = Counter(row.result for row in self._rows)
        print(f"\n{', '.join(f'{count} {result}' for result, count in counts.items())};", end=" ")
        print(f"{time.monotonic() - began:.0f} s{', interrupted' if self._is_interrupted else ''}.")
        return 1 if counts[FAILED] or self._is_interrupted else 0

    def _add(self, row: Row) -> None:
        self._rows.append(row)
        _tell(f"{row.result:8}{row.name}: {row.measured}")

    async def _begin(self) -> Session:
        """Look at the vehicle and its state, and say what may be changed."""
        options = self._options
        async with ParamClient(self._relay.link, cache=False) as client:
            vehicle = await client.component(options.system, timeout=SEARCH_TIMEOUT)
            await anyio.sleep(LISTENING_TIME)
            if options.system is None and len(client.autopilots) > 1:
                found = ", ".join(f"{each.system} ({each.autopilot})" for each in client.autopilots)
                text = f"{len(client.autopilots)} vehicles on this link: {found}. Choose one with --system"
                raise UsageError(text)
            if options.kind not in (None, vehicle.autopilot):
                raise UsageError(f"the vehicle is {vehicle.autopilot}, not {options.kind}")
            if not options.read_only:
                await check_disarmed(vehicle)
            result = await vehicle.fetch_all(timeout=CHECK_TIMEOUT)
            if missing := len(result.missing):
                raise UsageError(f"{missing} parameters were not received; see what is wrong with the link")
            listed = {name: param for name, param in result.params.items() if param.index is not None}
            journal = Journal(self._folder)
            journal.begin(vehicle, listed)
            choice = choose(vehicle.autopilot, listed)
            _tell(f"{vehicle.identity}, {len(listed)} parameters")
            if options.read_only or not choice.names:
                reason = (
                    "" if options.read_only else ": no parameter of this autopilot is known to be harmless"
                )
                _tell(f"Changes nothing{reason}.")
            else:
                _tell(f"Changes, and puts back: {', '.join(choice.names)}")
                _tell(f"The state before is in {journal.file} until it is back.")
            vehicle_kind = vehicle.system, vehicle.autopilot
            return Session(self._relay, self._folder, journal, *vehicle_kind, options.second_link, choice)

    async def _make(self, check: Check, session: Session) -> None:
        """Make one check and add its row."""
        result, text = FAILED, f"no end within {CHECK_TIMEOUT:.0f} s"
        if check.kinds is not None and session.kind not in check.kinds:
            result, text = SKIPPED, f"has a meaning for {' and '.join(check.kinds)} only"
        elif check.writes and self._options.read_only:
            result, text = SKIPPED, "changes parameters"
        else:
            with anyio.move_on_after(CHECK_TIMEOUT):
                result, text = await _outcome_of(check, session)
        self._add(Row(check.name, text, check.promise, result))

    async def _stop_on_signals(self, scope: anyio.CancelScope) -> None:
        """End the checks on Ctrl-C and the like, and say why the program goes on for a while."""
        wanted = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        # not on Windows; there Ctrl-C cancels the whole run, which puts back too
        with suppress(NotImplementedError), anyio.open_signal_receiver(*wanted) as signals:
            async for _ in signals:
                self._is_interrupted = True
                _tell("Stopping. What was changed is put back first.")
                scope.cancel()

    async def _end(self, session: Session) -> None:
        """Put back what is still changed, compare with the state before, and add the last row."""
        keep, writes = self._folder / "keep", not self._options.read_only
        if writes:
            keep.touch()
        problems: list[str] = []
        changed: list[str] = []
        try:
            with anyio.fail_after(PUT_BACK_TIMEOUT):
                self._relay.change(CLEAN)
                async with session.client() as vehicle:
                    problems += await session.journal.put_back(vehicle)
                    result = await vehicle.fetch_all(refresh=True)
                    if not result.complete:
                        problems.append(f"{len(result.missing)} parameters were not received at first")
                        result = await vehicle.fetch_all(refresh=True)
            listed = {name: param for name, param in result.params.items() if param.index is not None}
            wrong, changed = session.journal.differences(listed)
            problems += wrong
        except (ParamClientError, TimeoutError) as error:
            problems.append(f"{type(error).__name__}: {error}")
        text = f"{len(session.journal.before)} parameters as before"
        if changed:
            text += f"; changed by the vehicle itself: {', '.join(changed)}"
        result_text = "; ".join(problems) or text
        self._add(Row("state after", result_text, "the state before", FAILED if problems else OK))
        if not problems:
            keep.unlink(missing_ok=True)
        elif writes:
            _tell(f"To bring it back: paramclient restore {self._options.link} {session.journal.file}")


async def _outcome_of(check: Check, session: Session) -> tuple[str, str]:
    """Make a check; its result, and what it has measured or why it has failed."""
    try:
        return OK, await check.run(session)
    except (Skip, VehicleArmed) as reason:
        return SKIPPED, str(reason)
    except CheckFailed as failure:
        return FAILED, str(failure)
    except Exception as error:  # whatever it is, the other checks are made and the state is put back
        return FAILED, repr(error)  # with those in a group


def _tell(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())

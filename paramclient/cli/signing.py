"""The subcommands signing setup and signing disable: set and remove the signing key of a vehicle."""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import CONNECTION, KeyOptions, Seconds
from paramclient.cli.output import print_json, print_line, printable
from paramclient.cli.session import VEHICLE_TIMEOUT, ChosenVehicle, Deadline, wait_for_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.signing import Signing, read_key
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.links import Link, create_link
from paramclient.wire.signing import SigningKey, SigningPolicy

__all__ = ["disable", "setup"]

PROOF_TIMEOUT: Final = 10.0
"""Seconds to wait for a response with the new signing state, without --timeout."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class SigningTarget(KeyOptions):
    """The vehicle, and the safety of the link. The texts below the fields are their help."""

    link_is_safe: Annotated[bool, CONNECTION] = False
    """Confirm that no other person or program can read this link: a USB cable, a wire. Default: ask."""

    vehicle: str | None = None
    """The vehicle: 4 or 4/1 (system and component id), or uid:HARDWARE-ID. Default: the only one heard."""

    timeout: Seconds = None
    """Timeout for the whole command in seconds. Default: 10 for the first heartbeat, and 10 for the
    verification."""

    json: bool = False
    """Print JSON."""

    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Log each step on stderr, without the key."""


_DEFAULTS: Final = SigningTarget()


def setup(
    url: str, /, *, present_key: Path | None = None, options: SigningTarget = _DEFAULTS
) -> Callable[[], Awaitable[int]]:
    """Set the signing key of a vehicle, and verify that the vehicle signs with it.

    The key is taken from --signing-key, --signing-passphrase or the environment. It is sent unencrypted: use
    a link that no other person or program can read.

    Args:
        url: The link, such as serial:/dev/ttyACM0:115200.
        present_key: A file with the vehicle's current key, if the vehicle requires signed frames on this
            link.
    """
    key = options.key
    if key is None:
        raise UsageError("no key is given; name one with --signing-key FILE or --signing-passphrase")
    present = None if present_key is None else read_key(present_key)
    _confirm(options, f"The key will be sent over {url} in clear text.")
    return partial(_setup, url, options, key, present)


def disable(url: str, /, *, options: SigningTarget = _DEFAULTS) -> Callable[[], Awaitable[int]]:
    """Remove the signing key of a vehicle, and verify that it neither signs nor requires signed frames.

    The current key (--signing-key, --signing-passphrase or the environment) is needed if the vehicle requires
    signed frames: PX4 always does, ArduPilot not over USB.

    Args:
        url: The link.
    """
    key = options.key
    _confirm(options, f"The vehicle on {url} will then accept commands from any sender.")
    return partial(_disable, url, options, key)


def _confirm(options: SigningTarget, consequence: str) -> None:
    """Ask whether the link is safe, unless --link-is-safe is given.

    Raises:
        UsageError: the answer is no, or stdin is not a terminal.
    """
    if options.link_is_safe:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            "nothing was sent; add --link-is-safe if no other person or program can listen on this link"
        )
    sys.stderr.write(
        f"{printable(consequence)} Can no other person or program listen or send on this link? [y/N] "
    )
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("nothing was sent")


async def _setup(url: str, options: SigningTarget, key: SigningKey, present: SigningKey | None) -> int:
    deadline = Deadline(options.timeout)
    link = create_link(url)
    address = await _send(link, options, deadline, key, present)
    signing = Signing(key, SigningPolicy.ACCEPT_ALL)
    async with ParamClient(link, cache=False, signing=signing, **options.source) as client:
        vehicle = await _read_value(client, address, deadline, "does not answer requests signed with the key")
        report = client.signing_report()
        if report is None or address not in {(each.system, each.component) for each in report.streams}:
            raise _refused(address, "answers, but does not sign with the key: it has not accepted the key")
    _show(options, vehicle, key)
    return ExitCode.DONE


async def _disable(url: str, options: SigningTarget, key: SigningKey | None) -> int:
    deadline = Deadline(options.timeout)
    link = create_link(url)
    address = await _send(link, options, deadline, None, key)
    async with ParamClient(link, cache=False, traffic=True, **options.source) as client:
        vehicle = await _read_value(client, address, deadline, "does not answer unsigned requests")
        before = _count_signed(client, address)
        await _read_value(client, address, deadline, "does not answer unsigned requests")
        if _count_signed(client, address) > before:
            raise _refused(address, "still signs; it may require its present key, see --signing-key")
    _show(options, vehicle, None)
    return ExitCode.DONE


async def _send(
    link: Link,
    options: SigningTarget,
    deadline: Deadline,
    key: SigningKey | None,
    present: SigningKey | None,
) -> tuple[int, int]:
    """Send SETUP_SIGNING, signed with the vehicle's current key if known; return the vehicle's address."""
    signing = None if present is None else Signing(present, SigningPolicy.ACCEPT_ALL)
    async with ParamClient(link, cache=False, signing=signing, **options.source) as client:
        timeout = VEHICLE_TIMEOUT if options.timeout is None else deadline.left()
        choice = ChosenVehicle.parse(options.vehicle)
        if choice.is_all:
            raise UsageError("a signing key is set on one vehicle at a time")
        vehicle = await wait_for_vehicle(client, choice, timeout=timeout, only=True)
        await vehicle.setup_signing(key, link_is_safe=True)
        return vehicle.system, vehicle.component


async def _read_value(
    client: ParamClient, address: tuple[int, int], deadline: Deadline, failure: str
) -> Component:
    """Read a value of the vehicle with the signing of the client; return the vehicle.

    Raises:
        VehicleError: the vehicle did not answer; the message ends with `failure`.
    """
    try:
        vehicle = await client.component(*address, timeout=deadline.left(PROOF_TIMEOUT))
        await vehicle.get(0, timeout=deadline.left(PROOF_TIMEOUT))
    except NoReply:
        raise _refused(address, failure) from None
    return vehicle


def _count_signed(client: ParamClient, address: tuple[int, int]) -> int:
    components = client.traffic_report().components
    return sum(each.totals["signed"] for each in components if (each.system, each.component) == address)


def _refused(address: tuple[int, int], failure: str) -> VehicleError:
    system, component = address
    return VehicleError(f"{system}/{component} {failure}", system=system, component=component)


def _show(options: SigningTarget, vehicle: Component, key: SigningKey | None) -> None:
    if options.json:
        print_json(
            {
                "system": vehicle.system,
                "component": vehicle.component,
                "autopilot": vehicle.autopilot,
                "signs": key is not None,
                "fingerprint": None if key is None else key.fingerprint,
            }
        )
        return
    name = f"{vehicle.system}/{vehicle.component} {vehicle.autopilot}"
    state = "no longer signs" if key is None else f"signs with the key {key.fingerprint} now"
    print_line(f"{name} {state}")

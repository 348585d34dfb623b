"""The commands that give a vehicle its signing key, and take it away: signing setup, signing disable."""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.connection import HEARING_PATIENCE, Deadline
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Id, KeyOptions, Seconds
from paramclient.cli.output import print_document, print_line, printable
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.signing import Signing, read_key
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.links import Link, create_link
from paramclient.protocol.wire import SigningKey, SigningPolicy

__all__ = ["disable", "setup"]

PROOF_PATIENCE: Final = 10.0
"""Seconds in which a vehicle must answer in the new way, where the user sets no limit."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleOptions(KeyOptions):
    """Which vehicle, and whether this may be sent to it. The texts below the fields are their help."""

    link_is_safe: bool = False
    """Nobody else can listen on this link: a USB cable, a wire. Without it, you are asked."""

    system: Id = None
    """The system to speak to, 1 to 255. Without it, the only one that is heard."""

    component: Id = None
    """The component to speak to, 1 to 255. Without it, the autopilot."""

    timeout: Seconds = None
    """Seconds for everything together. Without it, 10 to hear the vehicle, and 10 for the proof."""

    json: bool = False
    """Print JSON, for programs."""

    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Tell on stderr what is done, step by step; never the key."""


_DEFAULTS: Final = VehicleOptions()


def setup(
    url: str, /, *, present_key: Path | None = None, options: VehicleOptions = _DEFAULTS
) -> Callable[[], Awaitable[int]]:
    """Give a vehicle its signing key, and prove that it signs with it.

    The key is that of --signing-key, --signing-passphrase or the environment. It goes over the link in clear,
    so only where nobody else can listen.

    Args:
        url: The link, such as serial:/dev/ttyACM0:115200.
        present_key: A file with the key that the vehicle has now, where it asks for that on this link.
    """
    key = options.key
    if key is None:
        raise UsageError("which key? Name it with --signing-key FILE or --signing-passphrase")
    present = None if present_key is None else read_key(present_key)
    _confirm(options, f"The key will go over {url} in clear.")
    return partial(_setup, url, options, key, present)


def disable(url: str, /, *, options: VehicleOptions = _DEFAULTS) -> Callable[[], Awaitable[int]]:
    """Let a vehicle sign no more, and take what is not signed, and prove it.

    With the key that it has now (--signing-key, --signing-passphrase or the environment) where it asks for
    that: PX4 does always, ArduPilot not over USB.

    Args:
        url: The link.
    """
    key = options.key
    _confirm(options, f"From then on the vehicle will obey everybody who reaches it. This goes over {url}.")
    return partial(_disable, url, options, key)


def _confirm(options: VehicleOptions, what: str) -> None:
    """Ask whether the link is safe, unless that was said.

    Raises:
        UsageError: it is not, or there is nobody to ask.
    """
    if options.link_is_safe:
        return
    if not sys.stdin.isatty():
        raise UsageError("say --link-is-safe if nobody else can listen on this link; nothing was sent")
    sys.stderr.write(f"{printable(what)} Is it sure that nobody else can listen or send there? [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("nothing was sent")


async def _setup(url: str, options: VehicleOptions, key: SigningKey, present: SigningKey | None) -> int:
    deadline = Deadline(options.timeout)
    link = create_link(url)
    address = await _send(link, options, deadline, key, present)
    signing = Signing(key, SigningPolicy.ACCEPT_ALL)
    async with ParamClient(link, cache=False, signing=signing) as client:
        vehicle = await _proof(client, address, deadline, "does not answer what is signed with the key")
        report = client.signing_report()
        if report is None or address not in {(each.system, each.component) for each in report.streams}:
            raise _refused(
                address, "answers, but what it sends is not signed with the key: it has not taken it"
            )
    _tell(options, vehicle, key)
    return ExitCode.DONE


async def _disable(url: str, options: VehicleOptions, key: SigningKey | None) -> int:
    deadline = Deadline(options.timeout)
    link = create_link(url)
    address = await _send(link, options, deadline, None, key)
    async with ParamClient(link, cache=False, traffic=True) as client:
        vehicle = await _proof(client, address, deadline, "does not answer what is not signed")
        before = _signed(client, address)
        await _proof(client, address, deadline, "does not answer what is not signed")
        if _signed(client, address) > before:
            raise _refused(address, "goes on to sign; it may want this signed with the key that it has")
    _tell(options, vehicle, None)
    return ExitCode.DONE


async def _send(
    link: Link,
    options: VehicleOptions,
    deadline: Deadline,
    key: SigningKey | None,
    present: SigningKey | None,
) -> tuple[int, int]:
    """Send SETUP_SIGNING, signed with the key that the vehicle has where that is known; to whom it went."""
    signing = None if present is None else Signing(present, SigningPolicy.ACCEPT_ALL)
    async with ParamClient(link, cache=False, signing=signing) as client:
        patience = HEARING_PATIENCE if options.timeout is None else deadline.left()
        vehicle = await client.only_component(options.system, options.component, timeout=patience)
        await vehicle.setup_signing(key, link_is_safe=True)
        return vehicle.system, vehicle.component


async def _proof(
    client: ParamClient, address: tuple[int, int], deadline: Deadline, otherwise: str
) -> Component:
    """Read a value of the vehicle, as it would be read from now on."""
    patience = deadline.left(PROOF_PATIENCE)
    try:
        vehicle = await client.component(*address, timeout=patience)
        await vehicle.get(0, timeout=deadline.left(PROOF_PATIENCE))
    except NoReply:
        raise _refused(address, otherwise) from None
    return vehicle


def _signed(client: ParamClient, address: tuple[int, int]) -> int:
    components = client.traffic_report().components
    return sum(each.signed for each in components if (each.system, each.component) == address)


def _refused(address: tuple[int, int], what: str) -> VehicleError:
    system, component = address
    return VehicleError(f"{system}/{component} {what}", system=system, component=component)


def _tell(options: VehicleOptions, vehicle: Component, key: SigningKey | None) -> None:
    if options.json:
        from paramclient.documents.command import SignsDoc  # only here: loads pydantic

        print_document(
            SignsDoc(
                system=vehicle.system,
                component=vehicle.component,
                autopilot=vehicle.autopilot,
                signs=key is not None,
                fingerprint=None if key is None else key.fingerprint,
            )
        )
        return
    who = f"{vehicle.system}/{vehicle.component} {vehicle.autopilot}"
    how = "does not sign any more" if key is None else f"signs with the key {key.fingerprint} now"
    print_line(f"{who} {how}")

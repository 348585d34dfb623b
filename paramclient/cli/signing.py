"""The subcommands signing setup and signing disable: set and remove the signing key of a vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.json_output import taken
from paramclient.cli.options import CONNECTION, KeyOptions, Seconds
from paramclient.cli.output import can_ask, confirm, print_result
from paramclient.cli.session import ChosenVehicle, Deadline, wait_for_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.signing import Signing, read_key
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.links import Link, create_link
from paramclient.wire.signing import SigningKey, SigningPolicy

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


async def setup(
    url: str, /, *, present_key: Path | None = None, options: SigningTarget = SigningTarget()
) -> None:
    """Set the signing key of a vehicle, and verify that the vehicle signs with it.

    The key is taken from --signing-key or the environment. It is sent unencrypted: use a link that no other
    person or program can read.

    Args:
        url: The link, such as serial:/dev/ttyACM0:115200.
        present_key: A file with the vehicle's current key, if the vehicle requires signed frames on this
            link.
    """
    key = options.key
    if key is None:
        raise UsageError("no key is given; name one with --signing-key FILE, or set one in the environment")
    present = None if present_key is None else read_key(present_key)
    await _change(url, options, key, present, f"The key will be sent over {url} in clear text.")


async def disable(url: str, /, *, options: SigningTarget = SigningTarget()) -> None:
    """Remove the signing key of a vehicle, and verify that it neither signs nor requires signed frames.

    The current key (--signing-key or the environment) is needed if the vehicle requires signed frames: PX4
    always does, ArduPilot not over USB.

    Args:
        url: The link.
    """
    consequence = f"The vehicle on {url} will then accept commands from any sender."
    await _change(url, options, None, options.key, consequence)


async def _change(
    url: str, options: SigningTarget, key: SigningKey | None, present: SigningKey | None, consequence: str
) -> None:
    """Send SETUP_SIGNING with a key or with none, signed with the present one if known, and verify it.

    Raises:
        VehicleError: the vehicle does not answer afterwards, or has not changed its signing.
    """
    choice = ChosenVehicle.parse(options.vehicle, one="a signing key is set on one vehicle at a time")
    question = f"{consequence} Can no other person or program listen or send on this link?"
    if not (options.link_is_safe or (can_ask() and await confirm(question))):
        hint = "add --link-is-safe if no other person or program can listen on this link"
        raise UsageError(f"nothing was sent; {hint}")
    deadline, link = Deadline(options.timeout), create_link(url)
    # a vehicle on USB may answer unsigned
    signing = None if present is None else Signing(present, SigningPolicy.ACCEPT_ALL)
    async with _client(link, options, signing) as client:
        vehicle = await wait_for_vehicle(client, choice, deadline, only=True)
        await vehicle.setup_signing(key, link_is_safe=True)
        address, name = vehicle.address, f"{vehicle.system}/{vehicle.component}"
    async with _client(link, options, None if key is None else Signing(key)) as client:
        try:
            vehicle = await client.component(*address, timeout=deadline.left(PROOF_TIMEOUT))
            await vehicle.get(0, timeout=deadline.left(PROOF_TIMEOUT))
            before = _count_signed(client, address)
            await vehicle.get(0, timeout=deadline.left(PROOF_TIMEOUT))
        except NoReply as error:
            requests = "unsigned requests" if key is None else "requests signed with the key, or unsigned"
            raise VehicleError(f"{name} does not answer {requests}: {error}", *address) from None
        if key is None and _count_signed(client, address) > before:
            raise VehicleError(f"{name} still signs; it may require its old key, see --signing-key", *address)
    found = taken(vehicle, "system", "component", "autopilot")
    found |= {"signs": key is not None, "fingerprint": key and key.fingerprint}
    state = "no longer signs" if key is None else f"signs with the key {key.fingerprint} now"
    print_result(found, f"{name} {vehicle.autopilot} {state}", json=options.json)


def _client(link: Link, options: SigningTarget, signing: Signing | None) -> ParamClient:
    return ParamClient(link, cache=False, traffic=True, signing=signing, system=options.source_system)


def _count_signed(client: ParamClient, address: tuple[int, int]) -> int:
    components = client.traffic_report().components
    return sum(each.totals["signed"] for each in components if (each.system, each.component) == address)

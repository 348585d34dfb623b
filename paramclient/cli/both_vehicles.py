"""The two vehicles on one link, for the subcommand diff."""

from __future__ import annotations

from dataclasses import replace

from paramclient.cli.every_vehicle import run_on_all
from paramclient.cli.options import LinkOptions
from paramclient.cli.session import CommandSession, Deadline, connect, vehicle_in_words
from paramclient.cli.sources import check_link, is_file, names_vehicle, whole_table
from paramclient.cli.targets import find_vehicles
from paramclient.errors import AmbiguousVehicle
from paramclient.links import LinkKind, parse_link
from paramclient.model.paramset import ParamSet

__all__ = ["may_have_several", "resolve_both"]


def may_have_several(text: str, options: LinkOptions) -> bool:
    """Return whether a source is a link with possibly several vehicles, of which no option names one.

    Raises:
        UsageError: the text names no source.
    """
    is_chosen = options.system is not None or options.vehicle is not None or options.split_peers
    if is_chosen or is_file(text) or names_vehicle(text, options.cache):
        return False
    check_link(text)
    return parse_link(text).kind is not LinkKind.SIM


async def resolve_both(url: str, options: LinkOptions) -> tuple[ParamSet, ParamSet]:
    """Return the whole tables of the two vehicles on a link, by system id; of a single one, its table twice.

    Listens for 3 s, or for half of the time until the deadline.

    Raises:
        AmbiguousVehicle: more than two vehicles were heard; nothing was fetched.
        VehicleError: some parameters were not received; the message names them.
        NoReply: no vehicle was heard, or one did not answer.
        LinkError: the link cannot be opened, or failed.
    """
    async with connect(url, options) as session:
        left = session.deadline.left()
        listening = Deadline(None if left is None else left / 2)
        vehicles = await find_vehicles(session.client, options.component, None, listening)
        if len(vehicles) < 2:
            table = await whole_table(session, draws=True)
            return table, table
        if len(vehicles) > 2:
            words = [vehicle_in_words(each) for each in vehicles]
            first, second = (each.system for each in vehicles[:2])
            raise AmbiguousVehicle(
                f"{len(words)} vehicles on this link: {', '.join(words)}. `paramclient fetch {url} --all` "
                f"stores them all; then `paramclient diff {first} {second}` compares two",
                vehicles=words,
            )

        async def fetch(each: CommandSession) -> ParamSet:
            return await whole_table(each, draws=False)

        done = await run_on_all([replace(session, component=each) for each in vehicles], fetch)
        tables = [each.result for each in done if each.result is not None]
        for each in done:
            if each.error is not None:
                raise each.error
        return tables[0], tables[1]

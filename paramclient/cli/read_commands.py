"""The subcommands fetch and get."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import anyio

from paramclient.cli.default_sources import find_defaults, report_no_defaults, say_sources
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_output import JsonObject, fetch_json
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Status, by_index, milliseconds, report, say
from paramclient.cli.param_names import check_given, choose_names, learn_spelling, suggest
from paramclient.cli.param_table import ParamTable
from paramclient.cli.session import CommandSession, sessions
from paramclient.errors import ParamClientError
from paramclient.model.names import NameChoice, is_pattern
from paramclient.model.notation import hash_text
from paramclient.model.values import Param, Trust
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import FetchResult

__all__ = ["fetch", "get", "get_chosen", "report_all"]

AWAITED_NAMES_MAX: Final = 3
"""Parameters that the line about awaited values names."""
INDICES_SHOWN_MAX: Final = 20
"""Missing indices that a message names, so that it stays readable; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()


async def fetch(
    url: str,
    /,
    *names: str,
    refresh: bool = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

    Args:
        url: The link: udpin:0.0.0.0:14550, tcp:HOST:PORT, serial:PATH, sim:px4.
        names: Print only these names and patterns, such as "MC_*". All are fetched.
        refresh: Download even if the cache is up to date.
        changed: Print only values that differ from the firmware's defaults.
        metadata: A file with defaults; or vehicle, to download them from it.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    chosen, given = check_given(names), from_file(metadata)
    async with sessions(url, options, extended=extended) as found:

        async def work(session: CommandSession) -> _Fetched:
            result = await session.fetch(refresh=refresh)
            params = by_index(each for name, each in result.params.items() if name not in result.cached)
            table = ParamTable(params, more=("trust", lambda param: param.trust))
            if changed or options.json or metadata is not None:
                table.described = await find_defaults(session, metadata, given, params)
            return _Fetched(session, result, table)

        done = await found.work(work)
        found.report_others()
    fetched = [each.result for each in done if each.result is not None]
    if chosen and fetched:
        _keep([each.table for each in fetched], chosen)
    for each in fetched:
        for note in each.result.notes:
            report(f"{each.session.prefix}{note}")
    lacks_defaults = changed and not any(each.table.defaults for each in fetched)
    if changed:
        for each in fetched:
            each.table.keep_changed()
    code = found.show(done)
    for each in [] if options.json or lacks_defaults else fetched:
        if changed:
            say_sources(each.session.label, each.table.defaults)
        say(each.summary)
    for each in fetched:
        if missing := each.result.missing:
            report(
                f"incomplete: {each.session.label} did not send {counted(len(missing), 'parameter')}, "
                f"index {first_of(missing, INDICES_SHOWN_MAX)}; run the command again to request them"
            )
            code = max(code, ExitCode.INCOMPLETE)
    if lacks_defaults:
        report_no_defaults()
        code = max(code, ExitCode.INCOMPLETE)
    return code


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle confirms it.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    chosen, given = check_given((name, *names)), from_file(metadata)
    async with sessions(url, options, extended=extended) as found:

        async def work(session: CommandSession) -> _Read:
            params, errors = await get_chosen(session, chosen)
            known = given or await known_of_session(session, metadata)
            return _Read(ParamTable(params, metadata=known), errors)

        done = await found.work(work)
        found.report_others()
    read = [(each.session, each.result) for each in done if each.result is not None]
    code = found.show(done)
    for session, each in read:
        if doubt := session.component.session.encoding_doubt:
            report(f"{session.prefix}{doubt}")
        code = max(code, report_all(each.errors.values(), session.prefix))
    return code


@dataclass(frozen=True, slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session: values that are only cached are not."""

    session: CommandSession
    result: FetchResult
    table: ParamTable

    @property
    def summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result, client = self.result, self.session.client
        of = f" of {result.count}" if result.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        link = " on the whole link" if len(client.components) > 1 else ""
        return (
            f"{result.received}{of} {self.session.noun}s of {self.session.label} from "
            f"{result.source} in {result.elapsed:.2f} s, {lost}{trip}{client.bytes_received:,} "
            f"bytes received, {client.bytes_sent:,} sent{link}{crc}"
        )

    def as_json(self) -> JsonObject:
        """Return the JSON object."""
        return fetch_json(self.session.component, self.result, self.table.params, self.table.described)

    @property
    def columns(self) -> Sequence[str]:
        """The headings."""
        return self.table.columns

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows of the table."""
        return self.table.rows()


@dataclass(frozen=True, slots=True)
class _Read:
    """The parameters that were read from a vehicle, and the errors by name."""

    table: ParamTable
    errors: Mapping[str, ParamClientError]

    def as_json(self) -> JsonObject:
        """Return the JSON of the parameters with all their metadata, and of the errors."""
        failed = {name: str(error) for name, error in self.errors.items()}
        return {"params": self.table.as_json(whole=True)} | ({"errors": failed} if failed else {})

    @property
    def columns(self) -> Sequence[str]:
        """The headings."""
        return self.table.columns

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows of the table."""
        return self.table.rows()


def _keep(tables: Sequence[ParamTable], chosen: Sequence[str]) -> None:
    """Leave out all parameters that names and patterns do not choose.

    Raises:
        UsageError: one of them fits no parameter of any table.
    """
    received = {param.name for each in tables for param in each.params}
    kept = NameChoice(chosen).choose(received)
    for each in tables:
        each.keep(kept)


async def get_chosen(
    session: CommandSession, name_patterns: Sequence[str], *, is_fetched: bool = False
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched, unless it is already. Values that were received or confirmed by that
    are not read again.
    """
    component = session.component
    if not is_fetched and (is_fetched := any(map(is_pattern, name_patterns))):
        await session.fetch()
    await learn_spelling(component, name_patterns)
    names, unmatched = choose_names(component, name_patterns)
    known = component.params if is_fetched else {}
    found = {name: known[name] for name in names if name in known and known[name].trust is not Trust.CACHED}
    requested = [name for name in names if name not in found]
    errors: dict[str, ParamClientError] = {}

    async def read(name: str) -> None:
        try:
            found[name] = await component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            errors[name] = error

    with Status(f"waiting for {first_of(requested, AWAITED_NAMES_MAX)} of {session.label}"):
        async with anyio.create_task_group() as tasks:
            for name in requested:
                tasks.start_soon(read, name)
    in_order = {name: errors[name] for name in requested if name in errors}
    return [found[name] for name in names if name in found], await suggest(session, in_order | unmatched)


def report_all(errors: Iterable[ParamClientError], prefix: str = "") -> int:
    """Print every error; return the exit code for all of them."""
    worst = ExitCode.DONE
    for error in errors:
        report(f"{prefix}{error}")
        worst = max(worst, code_of(error))
    return worst

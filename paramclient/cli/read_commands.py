"""The subcommands fetch and get."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import anyio

from paramclient.cli.json_output import JsonObject, fetch_json, param_json
from paramclient.cli.metadata import (
    MetadataChoice,
    defaults_in,
    from_file,
    info_of,
    known_of_session,
    meaning_of,
    report_no_defaults,
    say_sources,
    units_of,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import (
    LINE_NAMES_MAX,
    ExitCode,
    Status,
    by_index,
    milliseconds,
    report,
    report_all,
    say,
)
from paramclient.cli.param_names import check_given, choose_names, suggest
from paramclient.cli.session import CommandSession, sessions
from paramclient.errors import ParamClientError
from paramclient.metadata import Metadata
from paramclient.model.names import NameChoice, counted, first_of, is_pattern
from paramclient.model.notation import hash_text
from paramclient.model.paramset import Default, add_default, default_of
from paramclient.model.values import Param, Trust, format_value
from paramclient.protocol.fetch import FetchResult

AWAITED_NAMES_MAX: Final = 3
"""Parameters that the line about awaited values names."""

_DEFAULTS: Final = LinkOptions()


async def fetch(
    url: str,
    /,
    *names: str,
    refresh: bool = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

    Args:
        url: The link: udpin:0.0.0.0:14550, tcp:HOST:PORT, serial:PATH, sim:px4.
        names: Print only these names and patterns, such as "MC_*". All are fetched.
        refresh: Download even if the cache is up to date.
        changed: Print only values that differ from the firmware's defaults.
        metadata: A file with defaults; or vehicle, to download them from it.
    """
    chosen, given = check_given(names), from_file(metadata)
    async with sessions(url, options) as found:

        async def work(session: CommandSession) -> _Fetched:
            result = await session.fetch(refresh=refresh)
            params = by_index(each for name, each in result.params.items() if name not in result.cached)
            unknown = [param.name for param in params if param.default is None]
            described: Mapping[str, int | float] = {}
            if unknown and (changed or options.json or metadata is not None):
                described = defaults_in(given or await known_of_session(session, metadata), unknown)
            return _Fetched(session, result, params, described, shows_defaults=changed)

        done = await found.work(work)
    fetched = [each.result for each in done if each.result is not None]
    lacks_defaults = changed and not any(each.defaults for each in fetched)
    if chosen and fetched:
        kept = NameChoice(chosen).choose({param.name for each in fetched for param in each.params})
        for each in fetched:
            each.params = [param for param in each.params if param.name in kept]
    for each in fetched:
        if changed:
            each.params = [param for param in each.params if each.filled(param).is_changed]
        for note in each.result.notes:
            report(f"{each.session.prefix}{note}")
    code = found.show(done)
    for each in fetched:
        if not (options.json or lacks_defaults):
            if changed:
                say_sources(each.session.label, each.defaults)
            say(each.summary)
        if missing := each.result.missing:
            report(
                f"incomplete: {each.session.label} did not send {counted(len(missing), 'parameter')}, "
                f"index {first_of(missing, LINE_NAMES_MAX)}; run the command again to request them"
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
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle confirms it.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    chosen, given = check_given((name, *names)), from_file(metadata)
    async with sessions(url, options) as found:

        async def work(session: CommandSession) -> _Read:
            params, errors = await get_chosen(session, chosen)
            known = given or await known_of_session(session, metadata)
            return _Read(session, params, errors, known)

        done = await found.work(work)
    read = [each.result for each in done if each.result is not None]
    code = found.show(done)
    for each in read:
        if doubt := each.session.component.session.encoding_doubt:
            report(f"{each.session.prefix}{doubt}")
        code = max(code, report_all(each.errors.values(), each.session.prefix))
    return code


@dataclass(slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session: values that are only cached are not.

    Attributes:
        session: the vehicle.
        result: the fetch.
        params: the parameters.
        described: the defaults in the metadata by name, where the vehicle has given none.
        shows_defaults: whether the table has the defaults.
    """

    columns: ClassVar[Sequence[str]] = ("name", "value", "type", "index", "trust", "default")

    session: CommandSession
    result: FetchResult
    params: list[Param]
    described: Mapping[str, int | float]
    shows_defaults: bool

    @property
    def defaults(self) -> list[Default]:
        """The known defaults of the parameters."""
        found = (default_of(param, self.described.get(param.name)) for param in self.params)
        return [default for default in found if default is not None]

    def filled(self, param: Param) -> Param:
        """Return a parameter with its default."""
        return add_default(param, self.described.get(param.name))

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
        return fetch_json(self.session.component, self.result, self.params, self.described)

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter."""
        for param in self.params:
            default = self.filled(param).default if self.shows_defaults else None
            yield *_cells(param), param.trust, None if default is None else format_value(default, param.type)


@dataclass(frozen=True, slots=True)
class _Read:
    """The parameters that were read from a vehicle, the errors by name, and the metadata or None."""

    columns: ClassVar[Sequence[str]] = ("name", "value", "type", "index", "meaning", "units")

    session: CommandSession
    params: list[Param]
    errors: Mapping[str, ParamClientError]
    metadata: Metadata | None

    def as_json(self) -> JsonObject:
        """Return the JSON of the parameters with all their metadata, and of the errors."""
        failed = {name: str(error) for name, error in self.errors.items()}
        found = {
            each.name: param_json(each, info_of(self.metadata, each.name), whole=True) for each in self.params
        }
        return {"params": found} | ({"errors": failed} if failed else {})

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter, with meaning and units if metadata is known."""
        for param in self.params:
            meaning = meaning_of(self.metadata, param.name, param.settable)
            yield *_cells(param), meaning, units_of(self.metadata, param.name)


def _cells(param: Param) -> Sequence[object]:
    return param.name, format_value(param.settable, param.type), param.type.name, param.index


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

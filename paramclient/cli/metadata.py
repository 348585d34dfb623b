"""What the commands make of descriptions of parameters, where there are any: names of values, units, help."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import anyio
import anyio.to_thread
from cyclopts import Parameter

from paramclient.cache import CachedComponent, ParamCache
from paramclient.cli.connection import Session
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_line, printable, say
from paramclient.errors import UsageError
from paramclient.metadata import Metadata, MetadataStore, ParamInfo, metadata_of, read_metadata
from paramclient.metadata.info import number_of
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, Value, check_name, format_value

__all__ = [
    "DESCRIBED_COLUMNS",
    "MetadataChoice",
    "described_cells",
    "from_file",
    "info_of",
    "known_of_session",
    "known_of_sets",
    "known_of_table",
    "meaning_of",
    "needs_reboot",
    "parse_pairs",
    "print_descriptions",
    "problems",
    "resolved",
    "units_of",
]

MetadataChoice: TypeAlias = Annotated[str | None, Parameter(name="--metadata")]
"""A file that describes parameters, or `vehicle`."""

VEHICLE: Final = "vehicle"
"""Asks for what the vehicle itself says, instead of a file."""
IDENTITY_PATIENCE: Final = 0.5
"""Seconds that a vehicle has to say which firmware it runs, where something is kept of any firmware."""
IDENTITY_PAUSE: Final = 0.01
WORTH_SAYING: Final = 5_000
"""Bytes of a file that are announced to people: the first, general one is smaller."""


def from_file(choice: str | None, *, offline: bool = False) -> Metadata | None:
    """The descriptions of the file that was chosen; None where none was.

    Raises:
        UsageError: it is none, or the vehicle is to be asked where none is spoken to.
    """
    if choice == VEHICLE and offline:
        raise UsageError("--metadata vehicle needs a link; here it takes a file")
    return None if choice in (None, VEHICLE) else read_metadata(choice)


async def known_of_session(session: Session, choice: str | None, *, must: bool = False) -> Metadata | None:
    """What is known of the parameters of the vehicle that is spoken to.

    The vehicle itself is asked where that was chosen, or where it must be certain, as for what is written.
    Else what is kept of its firmware is taken, and nothing is asked.

    Raises:
        UsageError: it must be, and the vehicle does not describe its parameters.
        VehicleError, NoReply, LinkError: as `metadata_of`.
    """
    component = session.component
    if choice == VEHICLE or must:
        found = await metadata_of(component, timeout=session.deadline.left(), progress=_Reading(session.who))
        if found is None:
            raise UsageError(
                f"{session.who} does not describe its parameters; --metadata takes a file that does"
            )
        return found
    cache = session.client.cache
    store = None if cache is None else MetadataStore.beside(cache.path)
    if store is None or not store.has_notes:
        return None
    with anyio.move_on_after(session.deadline.left(IDENTITY_PATIENCE)):
        while not component.identity.git_hash:  # noqa: ASYNC110 - nobody tells
            await anyio.sleep(IDENTITY_PAUSE)
    return await anyio.to_thread.run_sync(store.known, component.identity, component.component)


class _Reading:
    """Says on a terminal that it may take a while."""

    def __init__(self, who: str) -> None:
        self._who = who
        self._has_said = not sys.stderr.isatty()

    def __call__(self, received: int, size: int | None) -> None:
        if not self._has_said and size is not None and size >= WORTH_SAYING:
            self._has_said = True
            say(printable(f"reading what {self._who} says of its parameters: {size:,} bytes"))


def known_of_table(cache: Path, table: CachedComponent) -> Metadata | None:
    """What is kept for the firmware that a cached table is of."""
    return MetadataStore.beside(cache).known(table.identity, table.component)


def known_of_sets(sets: Sequence[ParamSet], options: LinkOptions) -> list[Metadata | None]:
    """For each set what is kept for its vehicle's firmware; where it names none, what another one has."""
    if options.place is False:
        return [None] * len(sets)
    store = MetadataStore.beside(ParamCache(options.cache).path)
    return store.known_of_sets(sets)


# what is to be set


def parse_pairs(words: Sequence[str]) -> list[tuple[str, int | float | str]]:
    """The parameters and values that `set` is given, as `NAME VALUE` or `NAME=VALUE`.

    A value behind an equals sign may be a name, and is then still a text.

    Raises:
        UsageError: a name without a value, or what cannot be a name or value.
    """
    pairs: list[tuple[str, int | float | str]] = []
    left = iter(words)
    for word in left:
        name, equals, text = word.partition("=")
        if not equals:
            value = next(left, None)
            if value is None:
                break
            pairs.append((check_name(name), _number(name, value)))
        elif not text.strip():
            raise UsageError(f"{name}: there is no value behind the equals sign")
        else:
            number = _number_or_none(name, text)
            pairs.append((check_name(name), text if number is None else number))
    else:
        if pairs:
            return pairs
    raise UsageError(f"set takes pairs of NAME and VALUE, or NAME=VALUE, not {len(words)} words")


def resolved(
    pairs: Iterable[tuple[str, int | float | str]], metadata: Metadata | None
) -> list[tuple[str, int | float]]:
    """The same with a number for every name of a value.

    Raises:
        UsageError: a name that is none, or of a parameter that is not described.
    """
    numbers: list[tuple[str, int | float]] = []
    for name, value in pairs:
        if isinstance(value, str):
            info = info_of(metadata, name)
            if info is None:
                raise UsageError(f"{name}: {value!r} is no number, and {name} is not described")
            value = info.parse(value)
        numbers.append((name, value))
    return numbers


def problems(pairs: Iterable[tuple[str, int | float]], metadata: Metadata | None) -> Iterator[str]:
    """What speaks against values, in sentences: the vehicle has the last word."""
    for name, value in pairs:
        info = info_of(metadata, name)
        if info is not None and (problem := info.problem(value)) is not None:
            yield problem


def info_of(metadata: Metadata | None, name: str) -> ParamInfo | None:
    """What is known of a parameter."""
    return None if metadata is None else metadata.find(name)


# what is printed

DESCRIBED_COLUMNS: Final = ("meaning", "units")


def described_cells(metadata: Metadata, param: Param) -> tuple[str, str]:
    """What stands in these columns."""
    return meaning_of(metadata, param.name, param.value), units_of(metadata, param.name)


def meaning_of(metadata: Metadata | None, name: str, value: Value) -> str:
    """What a value means in a word, or "" where it is only a number."""
    info = info_of(metadata, name)
    return ("" if info is None else info.text(value)) or ""


def units_of(metadata: Metadata | None, name: str) -> str:
    """The units of a parameter, or "" where there are none or they are not known."""
    info = info_of(metadata, name)
    return "" if info is None else info.units


def needs_reboot(name: str, metadata: Metadata | None) -> bool:
    """Whether a new value counts only when the vehicle has started again, as far as that is known."""
    info = info_of(metadata, name)
    return info is not None and info.reboot_required


def print_descriptions(names: Iterable[str], metadata: Metadata) -> None:
    """Print all that is known of these parameters, for people."""
    for name in names:
        info = info_of(metadata, name)
        print_line("")
        if info is None:
            print_line(f"{name} is not described.")
            continue
        print_line(f"{name}: {info.short_description}" if info.short_description else name)
        for line in info.long_description.splitlines():
            print_line(f"  {line}" if line.strip() else "")
        for what, said in _said(info):
            print_line(f"  {what}: {said}")


def _said(info: ParamInfo) -> Iterator[tuple[str, str]]:
    units = f" {info.units}" if info.units else ""
    low, high = (None if bound is None else format_value(bound) for bound in (info.minimum, info.maximum))
    if low is not None and high is not None:
        yield "range", f"{low} to {high}{units}"
    elif low is not None or high is not None:
        yield "range", f"from {low} up{units}" if high is None else f"up to {high}{units}"
    elif units:
        yield "units", info.units
    if info.increment is not None:
        yield "step", f"{format_value(info.increment)}{units}"
    if info.default is not None:
        text = info.text(info.default)
        yield "default", format_value(info.default) + (f" ({text})" if text else units)
    for value, name in info.values.items():
        yield format_value(value), name
    for bit, name in info.bits.items():
        yield f"bit {bit}", name
    if info.is_read_only:
        yield "read-only", "the vehicle sets it"
    if info.reboot_required:
        yield "reboot", "a new value counts when the vehicle has started again"


def _number(name: str, text: str) -> int | float:
    number = _number_or_none(name, text)
    if number is None:
        raise UsageError(f"{name}: {text!r} is no number; 12, 0x1F, -1.5, 1e-3, nan and inf are")
    return number


def _number_or_none(name: str, text: str) -> int | float | None:
    """Read a value exactly: an integer as an int, everything else as a float; None for no number."""
    try:
        return None if text != text.strip() else number_of(text)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None

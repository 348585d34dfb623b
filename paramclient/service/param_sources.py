"""Parameter sets named in requests: files, earlier states, other components, cached vehicles, values."""

from __future__ import annotations

import base64
import binascii
from codecs import BOM_UTF8
from collections.abc import Awaitable, Callable
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from paramclient.documents.document import Body, InParts
from paramclient.errors import NotInCache, UnknownVehicle, UsageError
from paramclient.files import FileFormat, ParamFile, loads, loads_renames
from paramclient.files.param_file import TooManyParams
from paramclient.files.param_pck import is_packed
from paramclient.model.params import copy_params
from paramclient.model.paramset import ParamSet, RestorePoint, WrittenParam
from paramclient.model.patterns import is_pattern
from paramclient.model.values import Trust, check_name
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_restore_point, load_state_before_apply
from paramclient.provision.vehicle_params import (
    FetchedSet,
    fetch_set,
    load_cached_set,
    set_maker,
)
from paramclient.service.body_limits import PARAM_FILE_BYTES_MAX
from paramclient.service.problems import ServiceError
from paramclient.service.request_body import check_line_lengths, check_separators
from paramclient.service.route_context import Bits, ValueInput, parse_value, resolve_value

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, ParamCache
    from paramclient.model.renames import Renames
    from paramclient.service.followed_component import FollowedComponent
    from paramclient.service.hub import Hub

__all__ = [
    "EarlierState",
    "OtherComponent",
    "LimitedPatterns",
    "UploadedFile",
    "UploadedRenames",
    "Timestamp",
    "Number",
    "Pattern",
    "Patterns",
    "WantedParams",
    "FILE_NAME_LENGTH_MAX",
    "PATTERNS_MAX",
    "REQUEST_VALUES_MAX",
    "load_cached_table",
    "check_size",
    "wait_for_key",
    "read_cache",
    "current_set",
    "read_file",
    "read_renames",
    "load_cached_state",
    "parse_upload",
    "resolve_source",
    "load_last_restore_point",
    "load_state",
    "require_cache",
    "flush_cache",
    "parse_timestamp",
]

REQUEST_VALUES_MAX: Final = 10_000
"""Maximum number of values of a request, and of parameters of a file: more than a vehicle has."""
PATTERNS_MAX: Final = 64
"""Maximum number of patterns of a request: each is compared with every name."""
REQUEST_NAMES_MAX: Final = 10_000
"""Maximum number of names and patterns of a request: the page sends all selected names."""
FILE_NAME_LENGTH_MAX: Final = 255
"""Maximum number of characters of a file's name."""
TIMESTAMP_MAX: Final = 253_402_300_799.0
"""Last second of the year 9999: later times have no date."""

Result = TypeVar("Result")


def parse_timestamp(text: object) -> object:
    """Parse a time: unix seconds, or ISO 8601 with a time zone.

    Raises:
        ValueError: the text is neither.
    """
    if not isinstance(text, str):
        return text
    try:
        return float(text)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("a time must be unix seconds or ISO 8601 such as 2026-11-20T14:00:00Z") from None
    if moment.tzinfo is None:
        raise ValueError("a time needs a time zone, as in 2026-11-20T14:00:00Z")
    return moment.timestamp()


Timestamp = Annotated[
    float, BeforeValidator(parse_timestamp), Field(ge=0, le=TIMESTAMP_MAX, allow_inf_nan=False)
]
"""A time in unix seconds, also accepted as ISO 8601."""
Id = Annotated[int, Field(ge=1, le=255)]
"""A system or component id."""
Number = Annotated[int, Field(ge=1, lt=1 << 62)]
"""Number of a snapshot."""


def _check_patterns(given: tuple[str, ...]) -> tuple[str, ...]:
    if sum(map(is_pattern, given)) > PATTERNS_MAX:
        raise ValueError(f"at most {PATTERNS_MAX} of the names may be patterns with *, ? or [")
    return given


LimitedPatterns: Final = AfterValidator(_check_patterns)
"""Limits the number of patterns among names."""
Pattern = Annotated[str, Field(min_length=1, max_length=64)]
"""A name or a shell pattern. A long pattern with many unclosed brackets takes seconds to compile."""
Patterns = Annotated[
    tuple[Pattern, ...],
    Field(max_length=REQUEST_NAMES_MAX, fail_fast=True),
    LimitedPatterns,
]
"""Names and shell patterns."""
Values = Annotated[dict[str, ValueInput], InParts, Field(min_length=1, max_length=REQUEST_VALUES_MAX)]
"""Values by name."""


class UploadedFile(Body):
    """A parameter file, as text or in base64. Its name can indicate its format; `component` selects one of
    its sets."""

    name: Annotated[str, Field(max_length=FILE_NAME_LENGTH_MAX)] = ""
    text: str | None = None
    base64: str | None = None
    format: FileFormat | None = None
    component: Id | None = None

    @model_validator(mode="after")
    def _is_one(self) -> UploadedFile:
        if (self.text is None) == (self.base64 is None):
            raise ValueError("a file needs either `text` or `base64`")
        return self

    def read(self) -> ParamFile:
        """Parse the file. Blocks for up to seconds.

        Raises:
            FileError: the file is invalid.
            UsageError: the member is not base64.
            ServiceError: the file is too large.
        """
        if self.text is not None:
            data = self.text.encode("utf-8", "surrogatepass")
        else:
            try:
                data = base64.b64decode(self.base64 or "", validate=True)
            except (binascii.Error, ValueError) as error:
                raise UsageError(f"{self.name or 'the file'} is not valid base64: {error}") from None
        return parse_upload(data, self.name, self.format)


class UploadedRenames(Body):
    """A file of names that firmware versions have changed, as text; see `Renames`."""

    name: Annotated[str, Field(max_length=FILE_NAME_LENGTH_MAX)] = ""
    text: str

    def read(self) -> Renames:
        """Parse the file. Blocks for up to seconds.

        Raises:
            FileError: the file is invalid.
            ServiceError: the file exceeds a limit.
        """
        data = self.text.encode("utf-8", "surrogatepass")
        check_size(len(data), PARAM_FILE_BYTES_MAX)
        check_separators(data)
        check_line_lengths(data)
        return loads_renames(data, source=self.name)


async def read_renames(hub: Hub, given: UploadedRenames | None) -> Renames | None:
    """Parse a file of changed names in the file thread. None without a file.

    Raises:
        FileError: the file is invalid.
        ServiceError: the file exceeds a limit.
    """
    return None if given is None else await hub.run_in_file_thread(given.read)


class OtherComponent(Body):
    """Another component on a link of the service."""

    system: Id
    component: Id
    link: Annotated[str, Field(max_length=200)] | None = None


class CachedSource(Body):
    """A component in the cache: its last known table, a snapshot, or its table at a time."""

    key: Annotated[str, Field(min_length=1, max_length=400)]
    component: Id
    snapshot: Number | None = None
    at: Timestamp | None = None


class EarlierState(Body):
    """An earlier state: a snapshot, a time, or without both the state before the last apply.

    Without both, a restore after that apply is an error, because another one would undo later changes.
    """

    snapshot: Number | None = None
    at: Timestamp | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if self.snapshot is not None and self.at is not None:
            raise ValueError("`snapshot` and `at` exclude each other")
        return self

    @property
    def when(self) -> int | float | None:
        """The number of the snapshot, the time, or None."""
        return self.at if self.snapshot is None else self.snapshot


class WantedParams(Body):
    """A parameter set of a request. Exactly one member is given.

    `snapshot` (its number) and `at` (a time) are earlier states of the component in the path, `component` is
    another connected component, `vehicle` a component in the cache, `values` are given values, `defaults`
    are the firmware's defaults.
    """

    file: UploadedFile | None = None
    snapshot: Number | None = None
    at: Timestamp | None = None
    component: OtherComponent | None = None
    vehicle: CachedSource | None = None
    values: Values | None = None
    defaults: Literal[True] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> WantedParams:
        if len(self.model_fields_set) != 1 or None in (getattr(self, name) for name in self.model_fields_set):
            raise ValueError(
                f"a source needs exactly one of these members: {', '.join(type(self).model_fields)}"
            )
        return self


def parse_upload(data: bytes, name: str, file_format: FileFormat | None) -> ParamFile:
    """Parse a received parameter file. Blocks for up to seconds.

    Raises:
        FileError: the file is invalid.
        ServiceError: the file exceeds a limit.
    """
    check_size(len(data), PARAM_FILE_BYTES_MAX)
    check_separators(data)
    if not _has_no_lines(data, file_format):
        check_line_lengths(data)
    try:
        file = loads(data, source=name, file_format=file_format, params_max=REQUEST_VALUES_MAX)
        TooManyParams.check(sum(map(len, file.sets)), REQUEST_VALUES_MAX, name)
    except TooManyParams:
        what = f"A file may have at most {REQUEST_VALUES_MAX:,} parameters."
        raise ServiceError(413, "too-large", what, most=REQUEST_VALUES_MAX) from None
    return file


def _has_no_lines(data: bytes, file_format: FileFormat | None) -> bool:
    """Return whether a file is JSON or packed, and therefore not parsed by lines."""
    if file_format is not None:
        return file_format in (FileFormat.JSON, FileFormat.PCK)
    return is_packed(data) or data.removeprefix(BOM_UTF8).lstrip().startswith(b"{")


async def resolve_source(hub: Hub, target: FollowedComponent, source: WantedParams) -> ParamSet:
    """Return the parameter set of a source.

    Fetches the whole table of another connected component.

    Args:
        target: the component in the path.

    Raises:
        ServiceError: the component, vehicle, snapshot or state is unknown.
        UsageError: the source is `defaults`, which are not a set of their own.
        ParamClientError: the set cannot be read, or is incomplete.
    """
    if source.file is not None:
        return _choose(await read_file(hub, source.file.read), target, source.file.component)
    if source.component is not None:
        where = source.component
        other = hub.find_component(where.system, where.component, where.link)
        found = await fetch_set(other.component, source=f"link {other.link.name}")
        return found.set
    if source.vehicle is not None:
        kept = source.vehicle
        if kept.snapshot is not None and kept.at is not None:
            raise UsageError("`snapshot` and `at` exclude each other")
        when = kept.at if kept.snapshot is None else kept.snapshot
        return await load_cached_state(hub, kept.key, kept.component, when)
    if source.values is not None:
        return await _set_of_values(hub, target, source.values)
    if source.defaults:
        raise UsageError("the firmware's defaults can only be the base of a comparison")
    return await load_state(hub, target, source.at if source.snapshot is None else source.snapshot)


async def load_state(hub: Hub, target: FollowedComponent, when: float | int | None) -> ParamSet:
    """Return an earlier state of a connected component.

    Args:
        when: a float is a time in unix seconds, an int the number of a snapshot, None the state before the
            last apply.

    Raises:
        AlreadyRestored: a restore ran since the last apply, and `when` is None.
        ServiceError: the state is unknown, or there is no cache.
    """
    cache = require_cache(hub)
    key, component = await wait_for_key(hub, target), target.component.component
    if when is None:
        return await read_cache(hub, lambda: load_state_before_apply(cache, key, component))
    return await load_cached_state(hub, key, component, when)


async def load_last_restore_point(hub: Hub, target: FollowedComponent) -> RestorePoint:
    """Return the state before the last apply of a connected component, and what its restore undoes.

    Raises:
        AlreadyRestored, ServiceError: as from `load_state`.
    """
    cache = require_cache(hub)
    key, component = await wait_for_key(hub, target), target.component.component
    return await read_cache(hub, lambda: load_restore_point(cache, key, component))


async def wait_for_key(hub: Hub, target: FollowedComponent) -> str:
    """Wait for the identity of a component and return its key, after all received values are in the cache."""
    await wait_for_identity(target.component)
    await flush_cache(hub)
    return target.component.identity.key


async def flush_cache(hub: Hub) -> None:
    """Write all received values to the cache.

    Raises:
        CacheError: the cache cannot be written, so that reads from it would be incomplete.
    """
    for _, client in hub.clients():
        await client.core.cache_writer.write_all()


async def load_cached_state(hub: Hub, key: str, component: int, when: float | int | None) -> ParamSet:
    """Return a cached state of a component.

    Args:
        when: a float is a time in unix seconds, an int the number of a snapshot, None the last known table
            if it is complete.

    Raises:
        ServiceError: the vehicle or state is unknown, the table is incomplete, or there is no cache.
    """
    cache = require_cache(hub)
    await load_cached_table(hub, key, component)
    if when is None:
        return await read_cache(hub, lambda: load_cached_set(cache, key, component))
    return await read_cache(hub, lambda: cache.state_at(key, component, when))


async def load_cached_table(hub: Hub, key: str, component: int) -> CachedComponent:
    """Return a table in the cache.

    Raises:
        ServiceError: the table is unknown.
    """
    cache = require_cache(hub)
    await flush_cache(hub)
    table = await hub.run_in_thread(lambda: cache.load(key, component))
    if table is None:
        what = f"The cache has no table of component {component} of vehicle {key!r}."
        raise ServiceError(404, "unknown-vehicle", what)
    return table


def require_cache(hub: Hub) -> ParamCache:
    """Return the cache.

    Raises:
        ServiceError: there is no cache.
    """
    if hub.cache is None:
        raise ServiceError(409, "no-cache", "The service runs without a cache and has no earlier states.")
    return hub.cache


async def read_cache(hub: Hub, look: Callable[[], Result]) -> Result:
    """Read from the cache in a worker thread.

    Raises:
        ServiceError: 404, the cache has no such state.
        CacheError: the cache cannot be read.
    """
    try:
        return await hub.run_in_thread(look)
    except (NotInCache, UnknownVehicle) as error:  # UnknownVehicle: removed by another program
        raise ServiceError(404, "unknown-state", str(error), error=type(error).__name__) from error


async def current_set(
    target: FollowedComponent, run: Callable[[Callable[[], FetchedSet]], Awaitable[FetchedSet]]
) -> FetchedSet:
    """Return the current table of a component without requests, if it was received or verified in this
    session.

    Args:
        target: the component.
        run: runs the work, which is long for a large table.

    Raises:
        ServiceError: the table is incomplete or not verified, and must be fetched.
    """
    component = target.component
    table, count = copy_params(component.params), component.count
    to_set = set_maker(component, f"link {target.link.name}")

    def take() -> FetchedSet:
        params = list(table.values())
        unsure = sum(param.trust is Trust.CACHED for param in params)
        listed = sum(param.index is not None for param in params)
        if not params or unsure or count is None or listed < count:
            received = f"{listed - unsure} of {'?' if count is None else count}"
            what = f"{received} parameters were received or verified in this session. Fetch the table first."
            raise ServiceError(409, "incomplete", what)
        return FetchedSet(to_set(params), params, ())

    return await run(take)


def check_size(size: int, most: int) -> None:
    """Check the size of received data.

    Raises:
        ServiceError: 413, the data is too large.
    """
    if size > most:
        raise ServiceError(413, "too-large", f"A file may have at most {most:,} bytes.", most=most)


async def read_file(hub: Hub, read: Callable[[], ParamFile]) -> ParamFile:
    """Parse a file in the file thread.

    Raises:
        FileError: the file is invalid.
    """
    return await hub.run_in_file_thread(read)


def _choose(file: ParamFile, target: FollowedComponent, component: int | None) -> ParamSet:
    """Return the set of a file for a component; system ids count only in a file with several systems."""
    is_of_several = len({each.system for each in file.sets}) > 1
    component_id = target.component.component if component is None else component
    return file.choose(component_id, system=target.component.system if is_of_several else None)


async def _set_of_values(hub: Hub, target: FollowedComponent, values: dict[str, ValueInput]) -> ParamSet:
    """Return values as a set. Types of bits are read from the vehicle; other values are parsed in a
    thread."""
    of_bits = {
        name: await resolve_value(target, name, given)
        for name, given in values.items()
        if isinstance(given, Bits)
    }
    metadata = target.metadata

    def work() -> ParamSet:
        return ParamSet(
            {
                name: WrittenParam(
                    check_name(name),
                    parse_value(metadata, name, given) if not isinstance(given, Bits) else of_bits[name],
                )
                for name, given in values.items()
            }
        )

    return await hub.run_in_file_thread(work)

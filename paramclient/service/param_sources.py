"""What requests mean by parameters: a file, an earlier state, another vehicle, values as they stand."""

from __future__ import annotations

import base64
import binascii
from codecs import BOM_UTF8
from collections.abc import Callable
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from paramclient.client.client import local_client
from paramclient.documents.document import Body, InParts
from paramclient.errors import NotInCache, UnknownVehicle, UsageError
from paramclient.files import FileForm, ParamFile, loads
from paramclient.files.param_file import TooManyParams
from paramclient.files.param_pck import is_packed
from paramclient.model.params import copy_params
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import is_pattern
from paramclient.model.values import Trust, check_name
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.runner import Runner
from paramclient.provision.vehicle_params import (
    FetchedSet,
    fetch_set,
    load_cached_set,
    load_state_before_apply,
    set_maker,
)
from paramclient.service.problems import ServiceError
from paramclient.service.reading import check_lines, check_pieces
from paramclient.service.request import LARGEST_UPLOAD
from paramclient.service.route_context import Bits, ValueGiven, value_meant, value_of

if TYPE_CHECKING:
    from paramclient.cache import CachedComponent, ParamCache
    from paramclient.service.followed_component import Followed
    from paramclient.service.hub import Hub

__all__ = [
    "Elsewhere",
    "FewPatterns",
    "GivenFile",
    "Moment",
    "Number",
    "Patterns",
    "Source",
    "LARGEST_UPLOAD",
    "LONGEST_NAME",
    "MOST_PATTERNS",
    "MOST_VALUES",
    "cached",
    "check_size",
    "key_of",
    "known_to",
    "known_set",
    "parsed",
    "past",
    "read_upload",
    "resolved",
    "state",
    "the_cache",
    "written",
    "when_of",
]

MOST_VALUES: Final = 10_000
"""Values of one request, and parameters of one file: more than a vehicle has."""
MOST_PATTERNS: Final = 64
"""Patterns of one request: each is compared with every name."""
MOST_NAMES: Final = 10_000
"""Names of one request, with its patterns: the page sends the names that were chosen, one by one."""
LONGEST_NAME: Final = 255
"""Characters of a file's name."""
LATEST: Final = 253_402_300_799.0
"""The last second of the year 9999: what stands beyond cannot be written as a date."""

Result = TypeVar("Result")


def when_of(text: object) -> object:
    """A moment as a program writes it: unix seconds, or ISO 8601 with a zone."""
    if not isinstance(text, str):
        return text
    try:
        return float(text)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("a time is unix seconds, or as 2026-11-20T14:00:00Z") from None
    if moment.tzinfo is None:
        raise ValueError("a time needs its zone, as in 2026-11-20T14:00:00Z")
    return moment.timestamp()


Moment = Annotated[float, BeforeValidator(when_of), Field(ge=0, le=LATEST, allow_inf_nan=False)]
"""A time, in unix seconds when it is read."""
Id = Annotated[int, Field(ge=1, le=255)]
Number = Annotated[int, Field(ge=1, lt=1 << 62)]


def _few_patterns(given: tuple[str, ...]) -> tuple[str, ...]:
    if sum(map(is_pattern, given)) > MOST_PATTERNS:
        raise ValueError(
            f"at most {MOST_PATTERNS} of them may be patterns, with *, ? or [; the others are names"
        )
    return given


FewPatterns: Final = AfterValidator(_few_patterns)
"""Stands with names and patterns of which few may be patterns."""
Patterns = Annotated[
    tuple[Annotated[str, Field(min_length=1, max_length=64)], ...],
    Field(max_length=MOST_NAMES, fail_fast=True),
    FewPatterns,
]
"""Names, and patterns of the shell."""
Values = Annotated[dict[str, ValueGiven], InParts, Field(min_length=1, max_length=MOST_VALUES)]
"""Values by name."""


class GivenFile(Body):
    """A parameter file, as text or in base64. Its name may tell its form; `component` whose set is meant."""

    name: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    text: str | None = None
    base64: str | None = None
    form: FileForm | None = None
    component: Id | None = None

    @model_validator(mode="after")
    def _is_one(self) -> GivenFile:
        if (self.text is None) == (self.base64 is None):
            raise ValueError("a file is given either as text or in base64")
        return self

    def read(self) -> ParamFile:
        """The file. It takes its time.

        Raises:
            FileError: it cannot be read.
            UsageError: it is not base64.
            ServiceError: it is too large.
        """
        if self.text is not None:
            data = self.text.encode("utf-8", "surrogatepass")
        else:
            try:
                data = base64.b64decode(self.base64 or "", validate=True)
            except (binascii.Error, ValueError) as error:
                raise UsageError(f"{self.name or 'the file'} is no base64: {error}") from None
        return read_upload(data, self.name, self.form)


class Elsewhere(Body):
    """Another component that is heard."""

    system: Id
    component: Id
    link: Annotated[str, Field(max_length=200)] | None = None


class Cached(Body):
    """A component in the cache: as it was last known, in a snapshot, or at a time."""

    key: Annotated[str, Field(min_length=1, max_length=400)]
    component: Id
    snapshot: Number | None = None
    at: Moment | None = None


class Source(Body):
    """Where parameters are taken from. One of the members stands, and no other.

    `snapshot` (its number) and `at` are earlier states of the component that the request is about,
    `component` is another one that is heard, `vehicle` one in the cache, `values` stand here, `defaults` are
    the firmware's.
    """

    file: GivenFile | None = None
    snapshot: Number | None = None
    at: Moment | None = None
    component: Elsewhere | None = None
    vehicle: Cached | None = None
    values: Values | None = None
    defaults: Literal[True] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Source:
        if len(self.model_fields_set) != 1 or None in (getattr(self, name) for name in self.model_fields_set):
            raise ValueError(f"a source has one of these members: {', '.join(type(self).model_fields)}")
        return self


def read_upload(data: bytes, name: str, form: FileForm | None) -> ParamFile:
    """A parameter file that somebody has sent. It takes its time.

    Raises:
        FileError: it cannot be read.
        ServiceError: it is too large, or holds too many parameters.
    """
    check_size(len(data), LARGEST_UPLOAD)
    check_pieces(data)
    if not _has_no_lines(data, form):
        check_lines(data)
    try:
        file = loads(data, source=name, form=form, params_max=MOST_VALUES)
        TooManyParams.check(sum(map(len, file.sets)), MOST_VALUES, name)
    except TooManyParams:
        what = f"A file may hold {MOST_VALUES:,} parameters here, not more."
        raise ServiceError(413, "too-large", what, most=MOST_VALUES) from None
    return file


def _has_no_lines(data: bytes, form: FileForm | None) -> bool:
    """Whether a file is JSON or packed, and so is never looked at line by line."""
    if form is not None:
        return form in (FileForm.JSON, FileForm.PCK)
    return is_packed(data) or data.removeprefix(BOM_UTF8).lstrip().startswith(b"{")


async def resolved(hub: Hub, target: Followed, source: Source) -> ParamSet:
    """The parameters that a source stands for, of a request about this component.

    Another component that is heard is asked for its whole table.

    Raises:
        ServiceError: there is no such component, vehicle, snapshot or state.
        UsageError: it is `defaults`, which are no set of their own.
        ParamClientError: it cannot be read, or not all of it came.
    """
    if source.file is not None:
        return _choose(await parsed(hub, source.file.read), target, source.file.component)
    if source.component is not None:
        where = source.component
        other = hub.find(where.system, where.component, where.link)
        found = await fetch_set(other.component, source=f"link {other.line.name}", run=hub.read_aside)
        return found.set
    if source.vehicle is not None:
        kept = source.vehicle
        if kept.snapshot is not None and kept.at is not None:
            raise UsageError("a state in the cache is a snapshot or that of a time, not both")
        when = kept.at if kept.snapshot is None else kept.snapshot
        return await past(hub, kept.key, kept.component, when)
    if source.values is not None:
        return await _valued(hub, target, source.values)
    if source.defaults:
        raise UsageError("the firmware's defaults are a base to compare with, and nothing besides")
    return await state(hub, target, source.at if source.snapshot is None else source.snapshot)


async def state(hub: Hub, target: Followed, when: float | int | None) -> ParamSet:
    """An earlier state of a component that is heard.

    Args:
        when: a float is a time, an int the number of a snapshot, None is before the last apply.

    Raises:
        ServiceError: it is not known, or there is no cache.
    """
    cache = the_cache(hub)
    key, component = await key_of(hub, target), target.component.component
    if when is None:
        return await known_to(hub, lambda: load_state_before_apply(cache, key, component))
    return await past(hub, key, component, when)


async def key_of(hub: Hub, target: Followed) -> str:
    """The key under which a component is kept, when all that was heard of it is on the disk."""
    await wait_for_identity(target.component)
    await written(hub)
    return target.component.identity.key


async def written(hub: Hub) -> None:
    """Have everything on the disk that was heard so far.

    Raises:
        CacheError: it cannot be written, so that no answer from the cache would be the whole one.
    """
    for _, client in hub.clients():
        await local_client(client).cache_writer.write_all()


async def past(hub: Hub, key: str, component: int, when: float | int | None) -> ParamSet:
    """What the cache has of a component.

    Args:
        when: a float is a time, an int the number of a snapshot, None is what was last known, if that is all.

    Raises:
        ServiceError: the cache has no such vehicle, or not all of it, or no such state; or there is no cache.
    """
    cache = the_cache(hub)
    await cached(hub, key, component)
    if when is None:
        return await known_to(hub, lambda: load_cached_set(cache, key, component))
    return await known_to(hub, lambda: cache.state_at(key, component, when))


async def cached(hub: Hub, key: str, component: int) -> CachedComponent:
    """A table in the cache.

    Raises:
        ServiceError: there is none of this key.
    """
    cache = the_cache(hub)
    await written(hub)
    table = await hub.aside(lambda: cache.load(key, component))
    if table is None:
        what = f"The cache has no table of component {component} of a vehicle {key!r}."
        raise ServiceError(404, "unknown-vehicle", what)
    return table


def the_cache(hub: Hub) -> ParamCache:
    """Where tables are kept.

    Raises:
        ServiceError: nowhere.
    """
    if hub.cache is None:
        raise ServiceError(
            409, "no-cache", "This service keeps no cache, and so knows nothing of earlier times."
        )
    return hub.cache


async def known_to(hub: Hub, look: Callable[[], Result]) -> Result:
    """What the cache knows.

    Raises:
        ServiceError: it can be read, and does not know it.
        CacheError: it cannot be read.
    """
    try:
        return await hub.aside(look)
    except (NotInCache, UnknownVehicle) as error:  # the latter where another program has just removed it
        raise ServiceError(404, "unknown-state", str(error), error=type(error).__name__) from error


async def known_set(target: Followed, run: Runner) -> FetchedSet:
    """The table of a component as it stands here, if all of it was heard or confirmed in this session.

    Args:
        target: the component.
        run: runs what takes long for a large table.

    Raises:
        ServiceError: it was not; the vehicle has to be asked.
    """
    component = target.component
    table, count = copy_params(component.params), component.count
    to_set = set_maker(component, f"link {target.line.name}")

    def take() -> FetchedSet:
        params = list(table.values())
        unsure = sum(param.trust is Trust.CACHED for param in params)
        listed = sum(param.index is not None for param in params)
        if not params or unsure or count is None or listed < count:
            told = f"{listed - unsure} of {'?' if count is None else count}"
            what = f"{told} parameters were heard or confirmed in this session; fetch them first."
            raise ServiceError(409, "incomplete", what)
        return FetchedSet(to_set(params), params, ())

    return await run(take)


def check_size(size: int, most: int) -> None:
    """See that what somebody sends is not too large.

    Raises:
        ServiceError: it is.
    """
    if size > most:
        raise ServiceError(413, "too-large", f"A file may have {most:,} bytes here, not more.", most=most)


async def parsed(hub: Hub, read: Callable[[], ParamFile]) -> ParamFile:
    """Read a file in a thread: a long one takes seconds, and others have files too.

    Raises:
        FileError: it cannot be read.
    """
    return await hub.read_aside(read)


def _choose(file: ParamFile, target: Followed, component: int | None) -> ParamSet:
    """What a file has for a component; the system counts only in a file that has several."""
    is_of_several = len({each.system for each in file.sets}) > 1
    wanted = target.component.component if component is None else component
    return file.choose(wanted, system=target.component.system if is_of_several else None)


async def _valued(hub: Hub, target: Followed, values: dict[str, ValueGiven]) -> ParamSet:
    """Values as a set. What bits mean tells the vehicle, one by one; the others are read in a thread."""
    of_bits = {
        name: await value_of(target, name, given) for name, given in values.items() if isinstance(given, Bits)
    }
    metadata = target.metadata

    def work() -> ParamSet:
        return ParamSet(
            {
                name: WrittenParam(
                    check_name(name),
                    value_meant(metadata, name, given) if not isinstance(given, Bits) else of_bits[name],
                )
                for name, given in values.items()
            }
        )

    return await hub.read_aside(work)

"""Models of request bodies."""

from __future__ import annotations

from base64 import b64decode
from typing import Annotated, ClassVar, Final, Self

from pydantic import AwareDatetime, BaseModel, BeforeValidator, Field, model_validator
from pydantic import StrictFloat as Real
from pydantic import StrictInt as Whole

from paramclient.client.component import Component
from paramclient.files import FileFormat, ParamFile, loads
from paramclient.model.paramset import ParamSet

FILE_BYTES_MAX: Final = 2 * 2**20
"""Maximum size of a parameter file in bytes; a table of 10,000 parameters takes 1 MB."""
VALUES_MAX: Final = 10_000
"""Maximum number of values of a request: more than a vehicle has."""


class Body(BaseModel, frozen=True, extra="forbid"):
    """A request body. An unknown member is refused, so that a misspelt one is not ignored.

    Attributes:
        one_of: members of which exactly one is needed.
    """

    one_of: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if self.one_of and sum(getattr(self, each) is not None for each in self.one_of) != 1:
            raise ValueError(f"exactly one of {', '.join(self.one_of)} is needed")
        return self


def _parse_number(given: object) -> object:
    return int(given) if isinstance(given, str) and given.isdecimal() else given


def _decode(given: object) -> object:
    return b64decode(given, validate=True) if isinstance(given, str) else given


def _check_text(given: object) -> object:
    if not isinstance(given, str):
        raise ValueError("a time is text in ISO 8601, as 2026-11-20T14:00:00Z")
    return given


Name = Annotated[str, Field(min_length=1, max_length=16)]
Value = Annotated[
    Whole | Annotated[Real, Field(allow_inf_nan=False)] | Annotated[str, Field(max_length=400)],
    Field(
        description='A number, also as text such as "NaN", or the name of a value in the metadata; of an '
        "extended parameter also text, or bytes as hex:00ff."
    ),
]
Values = Annotated[dict[Name, Value], Field(min_length=1, max_length=VALUES_MAX)]
Seconds = Annotated[float | None, Field(gt=0, le=86_400, description="Timeout in seconds.")]
Patterns = Annotated[
    tuple[Annotated[str, Field(min_length=1, max_length=64)], ...], Field(max_length=VALUES_MAX)
]
Moment = Annotated[
    Annotated[Whole, Field(ge=1, lt=1 << 62)] | Annotated[AwareDatetime, BeforeValidator(_check_text)],
    BeforeValidator(_parse_number),
    Field(description="The number of a snapshot, or a time with its zone."),
]
Force = Annotated[
    bool, Field(description="Write values outside the range in the metadata, NaN and infinities.")
]
Durable = Annotated[bool, Field(description="Respond after value and history are on the disk.")]


class WriteOptions(Body):
    """Options of writes; see `Component.set`."""

    settle: Annotated[float, Field(ge=0, le=60, alias="settle_s")] = 0.0
    force: Force = False
    durable: Durable = False
    timeout: Annotated[Seconds, Field(alias="timeout_s")] = None


class WriteRequest(WriteOptions):
    """One value."""

    value: Value


class WriteManyRequest(WriteOptions):
    """Several values, by name; written in this order, many at a time."""

    values: Values


class FetchRequest(Body):
    """Options of a fetch; see `Component.fetch_all`. `metadata` also loads the metadata from the vehicle."""

    refresh: bool = False
    metadata: bool = False
    timeout_s: Seconds = None


class UploadedFile(Body):
    """A parameter file, as text or in base64. Its name can indicate its format; `component` selects a set."""

    one_of = ("text", "base64")
    name: Annotated[str, Field(max_length=255)] = ""
    text: Annotated[str, Field(max_length=FILE_BYTES_MAX)] | None = None
    base64: Annotated[bytes, BeforeValidator(_decode), Field(max_length=FILE_BYTES_MAX)] | None = None
    format: FileFormat | None = None
    component: Annotated[int, Field(ge=1, le=255)] | None = None

    def read(self, *, partial: bool = False) -> ParamFile:
        """Parse the file; see `files.loads`. Blocks for up to seconds.

        Raises:
            FileError: the file is invalid.
        """
        data = (self.text or "").encode("utf-8", "surrogatepass") if self.base64 is None else self.base64
        return loads(data, source=self.name, file_format=self.format, partial=partial)

    def read_set(self, component: Component) -> ParamSet:
        """Parse the file, and return its set for a component; see `read`."""
        file = self.read()
        is_of_several = len({each.system for each in file.sets}) > 1
        chosen = component.component if self.component is None else self.component
        return file.choose(chosen, system=component.system if is_of_several else None)


class PlanRequest(Body):
    """Wanted parameters: exactly one of `values`, `file` and `at`, limited to `only`."""

    one_of = ("values", "file", "at")
    values: Values | None = None
    file: UploadedFile | None = None
    at: Moment | None = None
    only: Patterns | None = None
    include: Patterns = ()
    force: Force = False


class RunOptions(Body):
    """Options of an apply or restore; see `paramclient.provision.apply`."""

    include: Patterns = ()
    force: Force = False
    reboot: bool = False
    allow_armed: bool = False
    timeout: Annotated[Seconds, Field(alias="timeout_s")] = None


class ApplyRequest(RunOptions, PlanRequest):
    """Wanted parameters with options."""

    partial: bool = False
    durable: Durable = False


class RestoreRequest(RunOptions):
    """The state to restore; without `at`, the state before the last apply."""

    at: Moment | None = None


class SnapshotRequest(Body):
    """Reason of a snapshot."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]

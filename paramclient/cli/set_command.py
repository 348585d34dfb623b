"""The subcommand set: values from the arguments, one outcome for each."""

from __future__ import annotations

import math
import shlex
from collections.abc import AsyncIterator, Iterable, Sequence
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.metadata import MetadataChoice, from_file, info_of, known_of_session
from paramclient.cli.options import LinkOptions, Settle
from paramclient.cli.output import can_ask, confirm, report
from paramclient.cli.param_names import learn_spelling, spelling
from paramclient.cli.read_commands import get_chosen
from paramclient.cli.session import CommandSession, check_link_argument, sessions, wait_for_firmware
from paramclient.cli.writes import WriteJob, write_all
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.metadata import Metadata
from paramclient.metadata.info import number_of
from paramclient.model.ext_values import parse_ext_value
from paramclient.model.values import WireValue, check_name, format_value

__all__ = ["set_"]

_DEFAULTS: Final = LinkOptions()


async def set_(
    url: str,
    /,
    *pairs: Annotated[str, Parameter(name="NAME VALUE", allow_leading_hyphen=True)],
    settle: Settle = 0.0,
    force: bool = False,
    durable: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Write parameters in the order given, and verify each by the value that the vehicle reports.

    A value is a decimal or hexadecimal number (0x1F), nan or inf; of an extended parameter also text, or
    bytes as hex:00FF. As NAME=VALUE, it may also be the name of a value, or names of bits separated by |, if
    metadata describes the parameter: it is downloaded from the vehicle unless --metadata names a file. A
    refused value does not stop the others. If several vehicles are heard, --vehicle must choose one, or all.
    A value outside the range in the metadata, or a fraction for an integer parameter, is written only after
    confirmation on a terminal, or with --force.

    Args:
        url: The link.
        pairs: A parameter, in upper or lower case, and its value, or NAME=VALUE. May be given several times.
        settle: Seconds to watch each value before it is read again. 1.2 detects values that PX4's modules
            clamp.
        force: Do not ask about values outside the range, and fractions for integers, which ArduPilot
            truncates. Send NaN and infinity also to PX4, which cannot save them and may stop, and to
            ArduPilot.
        durable: End only when all values and their history are on the disk and survive a power loss.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    check_link_argument(url)
    described = from_file(metadata)
    wanted = _parse_pairs(pairs, as_text=extended)
    if described is not None and not extended:
        wanted = _resolved(wanted, described)
    async with sessions(url, options, writes=True, extended=extended) as found:
        jobs = {each: await _prepare(each, wanted, described, metadata) for each in found}
        await _check_values([*jobs.values()], force=force)
        return await write_all(found, jobs, settle=settle, force=force, durable=durable)


async def _prepare(
    session: CommandSession,
    wanted: Sequence[tuple[str, WireValue]],
    described: Metadata | None,
    choice: MetadataChoice,
) -> WriteJob:
    """Return names and values as the vehicle and its metadata have them.

    Raises:
        UsageError: a text is no value of its parameter.
        ParamClientError: the type of an extended parameter could not be read.
    """
    component = session.component
    if component.is_extended:
        params, errors = await get_chosen(session, [name for name, _ in wanted])
        for error in errors.values():
            if not isinstance(error, UnknownParameter):  # the write reports that
                raise error
        types = {param.name: param.type_number for param in params}
        texts = [(spelling(name, component), str(text)) for name, text in wanted]
        values: list[tuple[str, WireValue]] = [
            (name, parse_ext_value(name, text, types[name]) if name in types else text)
            for name, text in texts
        ]
        return WriteJob(session, values, None)
    await learn_spelling(component, [name for name, _ in wanted])
    wanted = [(spelling(name, component), value) for name, value in wanted]
    if described is None:
        named = [f"{name}: {value!r} is not a number" for name, value in wanted if isinstance(value, str)]
        described = await known_of_session(session, choice, needed_for=named[0] if named else "")
    return WriteJob(session, _resolved(wanted, described), described)


async def _check_values(jobs: Sequence[WriteJob], *, force: bool) -> None:
    """Report values that are probably wrong; continue if the user confirms them, or with `force`.

    Raises:
        UsageError: the user does not confirm, or there is no terminal. Nothing was written.
    """
    doubts = dict.fromkeys([doubt for job in jobs async for doubt in _doubts(job)])
    for doubt in doubts:
        report(doubt)
    if not doubts or force:
        return
    if not can_ask():
        raise UsageError("nothing was written; --force writes these values all the same")
    await wait_for_firmware([job.session.component for job in jobs], jobs[0].session.deadline)
    receivers = ", ".join(job.session.receiver for job in jobs)
    if not await confirm(f"Write these values to {receivers} all the same?"):
        raise UsageError("nothing was written")


async def _doubts(job: WriteJob) -> AsyncIterator[str]:
    """Yield sentences on values outside the range, and on fractions for integers."""
    for name, value in job.writes:
        info = info_of(job.described, name)
        if info is not None and (problem := info.problem(value)) is not None:
            yield problem
        if not isinstance(value, float) or not math.isfinite(value) or value.is_integer():
            continue
        is_integer = info is not None and (
            bool(info.bits) or (info.type is not None and info.type.is_integer)
        )
        if not is_integer:
            component, timeout = job.session.component, job.session.deadline.left()
            try:
                known = component.params.get(name) or await component.get(name, timeout=timeout)
            except ParamClientError:
                continue  # the write will fail for the same reason, and say so
            is_integer = known.type.is_integer
        if is_integer:
            yield f"{name}: {format_value(value)} is not a whole number, and {name} is an integer"


# The arguments


def _parse_pairs(words: Sequence[str], *, as_text: bool = False) -> list[tuple[str, WireValue]]:
    """Parse parameters and values, as `NAME VALUE` or `NAME=VALUE`.

    A value after an equals sign may be the name of a value; it is returned as text. With `as_text`, every
    value is.

    Raises:
        UsageError: a name has no value, or a name or value is invalid.
    """
    pairs: list[tuple[str, WireValue]] = []
    left = iter(words)
    for word in left:
        if word.startswith("-"):  # values may be negative, so that an unknown option would be a name
            raise UsageError(f"Unknown option: {word.partition('=')[0]}. Nothing was written.")
        name, equals, text = word.partition("=")
        value = text if equals else next(left, None)
        if value is None:
            break
        if not as_text and equals and not value.strip():
            raise UsageError(f"{name}: there is no value after the equals sign")
        number = None if as_text else _number_or_none(name, value)
        if number is None and not (as_text or equals):
            if value.startswith("="):
                raise UsageError(f"write {name}=VALUE without spaces, or {name} VALUE without an equals sign")
            raise UsageError(
                f"{name}: {value!r} is not a number, such as 12, 0x1F, -1.5, 1e-3, nan or inf. "
                f"If it is the name of a value, write {shlex.quote(f'{name}={value}')}"
            )
        pairs.append((check_name(name), value if number is None else number))
    else:
        if pairs:
            return pairs
    end = f", and {words[-1]} has no value" if words else ""
    raise UsageError(f"set takes pairs of NAME and VALUE, or NAME=VALUE{end}")


def _number_or_none(name: str, text: str) -> int | float | None:
    """Parse a value exactly: an integer as an int, other numbers as a float; None if it is not a number."""
    try:
        return None if text != text.strip() else number_of(text)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None


def _resolved(
    pairs: Iterable[tuple[str, WireValue]], metadata: Metadata | None
) -> list[tuple[str, WireValue]]:
    """Return the pairs with every name of a value replaced by its number.

    Raises:
        UsageError: an unknown name of a value, or a parameter without metadata.
    """
    numbers: list[tuple[str, WireValue]] = []
    for name, value in pairs:
        if isinstance(value, str):
            info = info_of(metadata, name)
            if info is None:
                raise UsageError(f"{name}: {value!r} is not a number, and no metadata describes {name}")
            value = info.parse(value)
        numbers.append((name, value))
    return numbers

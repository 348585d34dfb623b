"""Extended parameters (PARAM_EXT_*) behind the routes of plain ones, with `?ext=true`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from paramclient.errors import UnknownParameter, UsageError
from paramclient.metadata.info import number_of
from paramclient.model.ext_values import check_ext_value, encode_ext_value, ext_param
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType, WireValue
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision import apply_extended, load_extended_state, restore_extended, verify_extended
from paramclient.service import documents
from paramclient.service.request_bodies import Bits, Hex

if TYPE_CHECKING:
    from paramclient.service.request_bodies import (
        ApplyRequest,
        FetchRequest,
        PlanRequest,
        RestoreRequest,
        WriteManyRequest,
        WriteRequest,
    )
    from paramclient.service.targets import Target

__all__ = ["apply", "fetch", "param", "params", "plan", "restore", "set_many", "set_one", "state"]


def params(target: Target) -> dict[str, dict[str, Any]]:
    """Return the known parameters by name."""
    return {name: documents.ext_param(each) for name, each in target.component.ext.params.items()}


async def param(target: Target, name: str, *, live: bool) -> dict[str, Any]:
    """Return a parameter as known, or read from the component."""
    known = target.component.ext.params.get(name)
    if live:
        known = await target.component.ext.get(name)
    if known is None:
        why = f"no value of {name} has been received yet"
        ids = target.component.system, target.component.component
        raise UnknownParameter(why, system=ids[0], component=ids[1], name=name, index=None, nearest=())
    return documents.ext_param(known)


async def fetch(target: Target, body: FetchRequest) -> dict[str, Any]:
    """Download all parameters."""
    return documents.ext_fetch_result(await target.component.ext.fetch_all(timeout=body.timeout_s))


async def set_one(target: Target, name: str, body: WriteRequest, *, author: str) -> dict[str, Any]:
    """Write a parameter, and wait until the component has acknowledged the value."""
    value = await _resolve(target, name, body.value)
    result = await target.component.ext.set(
        name, value, timeout=body.timeout_s, durable=body.durable, author=author
    )
    outcome = SetOutcome(name, value, SetStatus(result.status), result)
    (written,) = documents.ext_writes([outcome])["results"]
    return dict(written)


async def set_many(target: Target, body: WriteManyRequest, *, author: str) -> dict[str, Any]:
    """Write several parameters in order, several at a time."""
    values = {name: await _resolve(target, name, given) for name, given in body.values.items()}
    result = await target.component.ext.set_many(
        values, timeout=body.timeout_s, durable=body.durable, author=author
    )
    return documents.ext_writes(result.outcomes, result.error)


async def plan(target: Target, body: PlanRequest) -> dict[str, Any]:
    """Compare the component with wanted parameters."""
    return documents.ext_plan(await verify_extended(target.component, await _wanted(target, body)))


async def apply(target: Target, body: ApplyRequest, *, author: str) -> dict[str, Any]:
    """Write the wanted parameters that differ."""
    result = await apply_extended(
        target.component,
        await _wanted(target, body),
        durable=body.durable,
        timeout=body.timeout_s,
        author=author,
    )
    return documents.ext_apply_result(result)


async def restore(target: Target, body: RestoreRequest, *, author: str) -> dict[str, Any]:
    """Restore an earlier state."""
    earlier = await load_extended_state(target.component, body.when)
    if body.dry_run:
        return documents.ext_plan(await verify_extended(target.component, earlier))
    result = await restore_extended(target.component, earlier, timeout=body.timeout_s, author=author)
    return documents.ext_apply_result(result)


async def state(target: Target, when: float | None) -> dict[str, dict[str, Any]]:
    """Return the parameters of a snapshot or at a time."""
    found = await load_extended_state(target.component, when)
    return {name: documents.ext_written(each) for name, each in found.items()}


async def _wanted(target: Target, body: PlanRequest) -> ParamSet:
    """Return the wanted parameters, in the types that the component reports."""
    if body.file is not None:
        raise UsageError("extended parameters are given in `values` or `snapshot`, not in a file")
    if body.snapshot is not None:
        return await load_extended_state(target.component, body.snapshot)
    wanted = {}
    for name, given in (body.values or {}).items():
        known = await _known(target, name)
        raw = encode_ext_value(check_ext_value(await _resolve(target, name, given)), known.type_number)
        wanted[name] = WrittenParam.of(ext_param(name, raw, known.type_number))
    return ParamSet(wanted)


async def _known(target: Target, name: str) -> Param:
    return target.component.ext.params.get(name) or await target.component.ext.get(name)


async def _resolve(target: Target, name: str, given: int | float | str | Bits | Hex) -> WireValue:
    """Return the value of a request. Text for a number type is a number: JavaScript rounds 64-bit integers.

    Raises:
        UsageError: the value is not valid.
        ParamClientError: the component did not send the type of the parameter.
    """
    if isinstance(given, Hex):
        return bytes.fromhex(given.hex)
    if isinstance(given, Bits):
        raise UsageError(f'{name}: {{"bits": …}} is for plain parameters; give {{"hex": …}}')
    if not isinstance(given, str) or (await _known(target, name)).type == ParamType.CUSTOM:
        return given
    number = number_of(given)
    if number is None:
        raise UsageError(f"{name}: {given!r} is not a number")
    return number

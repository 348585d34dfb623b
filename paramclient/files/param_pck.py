"""param.pck as a parameter file: types, exact values and defaults, without vehicle and component."""

from __future__ import annotations

from paramclient.errors import FileError, PackError, UsageError
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, bits_of, from_bits, same_bits, type_name
from paramclient.protocol import param_pck

__all__ = ["is_packed", "read_packed", "write_packed"]


def is_packed(data: bytes) -> bool:
    """Return whether these bytes begin like a packed parameter file."""
    return data.startswith(param_pck.MAGICS)


def read_packed(data: bytes, source: str) -> ParamFile:
    """Read a packed file in the format that a vehicle serves.

    Raises:
        FileError: the file is invalid.
    """
    try:
        pack = param_pck.decode(data)
    except PackError as error:
        raise FileError(f"invalid packed parameter file: {error}", source=source) from error
    entries, with_defaults = pack.entries, pack.with_defaults
    if not entries:
        raise FileError("the file contains no parameters", source=source)
    notes = []
    if pack.total > len(entries):
        notes.append(f"The file contains {len(entries)} of the vehicle's {pack.total} parameters.")
    params = {}
    for name, kind, bits, default in entries:
        value = from_bits(bits, kind)
        given = value if default is None and with_defaults else None
        if default is not None:
            given = from_bits(default, kind)
        params[name] = WrittenParam(name, value, kind, given)
    return ParamFile((ParamSet(params, source=source),), FileFormat.PCK, source, notes=tuple(notes))


def write_packed(params: ParamSet) -> bytes:
    """Return the bytes of a packed file, with defaults if all of them are known.

    Raises:
        UsageError: the format cannot express a parameter: it has four types, and only numbers.
    """
    with_defaults = all(param.default is not None for param in params.values())
    entries = [_entry(param, with_defaults=with_defaults) for param in params.values()]
    return param_pck.encode(entries, with_defaults=with_defaults)


def _entry(param: WrittenParam, *, with_defaults: bool) -> param_pck.PackedParam:
    kind = param.type_number
    if not isinstance(kind, ParamType) or kind not in param_pck.PACKABLE:
        known = ", ".join(each.name for each in sorted(param_pck.PACKABLE))
        has = "no type" if kind is None else f"the type {type_name(kind)}"
        raise UsageError(f"{param.name} has {has}, and a packed file holds {known}")
    if param.is_raw:
        raise UsageError(f"{param.name} is not a number; json can keep it")
    bits = param.bits_as(kind)
    default = None
    if with_defaults and param.default is not None:
        default = bits_of(param.default, kind)
        if same_bits(kind, bits, default):
            default = None  # as vehicles write it: an entry without a default has its default value
    return param_pck.PackedParam(param.name, kind, bits, default)

"""param.pck as a parameter file: types, exact values and defaults, without vehicle and component."""

from __future__ import annotations

from paramclient.errors import FileError, PackError, UsageError
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.files.reading import Reading
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, bits_of, from_bits, same_bits, type_name
from paramclient.protocol import param_pck

__all__ = ["pack_entry", "read_packed", "write_packed"]


def read_packed(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a packed file in the format that a vehicle serves.

    Raises:
        FileError: the file is invalid.
    """
    try:
        pack = param_pck.decode(reading.data)
    except PackError as error:
        raise FileError(f"invalid packed parameter file: {error}", source=reading.source) from error
    if pack.total > len(pack.entries):
        reading.notes.append(
            f"The file contains {len(pack.entries)} of the vehicle's {pack.total} parameters."
        )
    for name, kind, bits, default in pack.entries:
        known = bits if default is None and pack.with_defaults else default
        value, own = from_bits(bits, kind), None if known is None else from_bits(known, kind)
        reading.add(WrittenParam(name, value, kind, own), "")
    return reading.file(file_format)


def write_packed(params: ParamSet) -> bytes:
    """Return the bytes of a packed file, with defaults if all of them are known.

    Raises:
        UsageError: the format cannot express a parameter: it has four types, and only numbers.
    """
    with_defaults = all(param.default is not None for param in params.values())
    entries = [pack_entry(params, param) for param in params.values()]
    return param_pck.encode(entries, with_defaults=with_defaults)


def pack_entry(_: ParamSet, param: WrittenParam) -> param_pck.PackedParam:
    """Return the entry of a parameter, or raise UsageError if the format cannot express it."""
    kind = param.type_number
    if not isinstance(kind, ParamType) or kind not in param_pck.PACKABLE:
        known = ", ".join(each.name for each in sorted(param_pck.PACKABLE))
        has = "no type" if kind is None else f"the type {type_name(kind)}"
        raise UsageError(f"{param.name} has {has}, and a packed file holds {known}")
    if param.is_raw:
        raise UsageError(f"{param.name} is not a number; json can keep it")
    bits = param.bits_as(kind)
    default = None if param.default is None else bits_of(param.default, kind)
    if default is not None and same_bits(kind, bits, default):
        default = None  # as vehicles write it: an entry without a default has its default value
    return param_pck.PackedParam(param.name, kind, bits, default)

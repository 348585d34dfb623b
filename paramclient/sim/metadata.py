"""Parameter metadata of a simulated vehicle: the files of the component metadata protocol."""

from __future__ import annotations

import json
import lzma
import math
from functools import cache
from importlib import resources
from typing import Any, Final

from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import TYPES_BY_NAME, ParamType
from paramclient.sim.param_table import SimParam

GENERAL_FILE: Final = "etc/extras/component_general.json.xz"
"""Path of PX4's general metadata file (COMPONENT_METADATA.hpp)."""
METADATA_FILE: Final = "etc/extras/parameters.json.xz"
"""Path of PX4's parameter metadata file (PX4's build)."""


@cache
def metadata_files(rows: tuple[SimParam, ...]) -> dict[str, bytes]:
    """Return the two packed files of a table, by path. Only a few parameters have more than a type."""
    path = resources.files(__package__).joinpath("tables", "px4_descriptions.json")
    known = json.loads(path.read_text(encoding="ascii"))
    described = [_described(row) | known.get(row.name, {}) for row in rows]
    parameters = _packed({"version": 1, "parameters": described})
    kinds = [{"type": 1, "uri": f"mftp://{METADATA_FILE}", "fileCrc": crc32_px4(parameters)}]
    return {
        GENERAL_FILE: _packed({"version": 1, "metadataTypes": kinds}),
        METADATA_FILE: parameters,
    }


def _packed(document: dict[str, Any]) -> bytes:
    return lzma.compress(json.dumps(document).encode(), preset=1)


def _described(row: SimParam) -> dict[str, Any]:
    value = row.value
    described: dict[str, Any] = {
        "name": row.name,
        "group": row.name.partition("_")[0],
        "category": "Standard",
        "shortDesc": f"{row.name} of the simulated vehicle",
    }
    if row.type in _TYPES:
        described["type"] = _TYPES[row.type]
    if isinstance(value, int | float) and math.isfinite(value):
        described["default"] = value
    if row.volatile:
        described["volatile"] = True
    return described


_TYPES: Final[dict[int, str]] = {
    kind: "Float" if kind is ParamType.REAL32 else kind.name.capitalize()
    for kind in TYPES_BY_NAME.values()
    if kind.size <= 4
}

"""What happens to the parameters of a component, as subscribers see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from paramclient.model.values import Param


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter that appeared, changed its value or type, or was removed.

    Attributes:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the vehicle no longer has it.
        by: the author: "us" (a `set` of this client), "us for NAME" (a `set` on behalf of NAME), "vehicle",
            or the system and component of another station whose PARAM_SET was seen.
        kind: "changed"; "first" for a value of a table that was never complete; "added" for a parameter that
            a complete table lacked; "removed".
    """

    name: str
    old: Param | None
    new: Param | None
    by: str
    kind: Literal["changed", "first", "added", "removed"]

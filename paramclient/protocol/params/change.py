"""A change of one parameter in a table."""

from __future__ import annotations

from paramclient.model.params import Held, held_of, param_of
from paramclient.model.values import Param, Value

__all__ = ["Change"]

_new = tuple.__new__  # the constructor of a tuple ends in this call and takes several times as long


class Change(tuple[str, Held | None, Held | None, str, Value | None, Value | None]):
    """One parameter that appeared, changed its value or was removed.

    Each first value makes a change; the parameters in it are therefore built only on access.

    Args:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the vehicle no longer has it.
        by: the author: "us" (our own `set`), "us for NAME" (a `set` on behalf of NAME), "vehicle", or
            "station S/C" for a PARAM_SET of another station.
    """

    __slots__ = ()

    def __new__(cls, name: str, old: Param | None, new: Param | None, by: str = "vehicle") -> Change:
        before, now = (None if each is None else held_of(each) for each in (old, new))
        defaults = (None if each is None else each.default for each in (new, old))
        return _new(cls, (name, before, now, by, *defaults))

    def __getnewargs__(self) -> tuple[str, Param | None, Param | None, str]:
        return self.name, self.old, self.new, self.by

    @property
    def name(self) -> str:
        """param_id."""
        return self[0]

    @property
    def old(self) -> Param | None:
        """The parameter before, or None for a new one."""
        return None if self[1] is None else param_of(self[0], self[1], self[5])

    @property
    def new(self) -> Param | None:
        """The parameter now, or None when the vehicle no longer has it."""
        return None if self[2] is None else param_of(self[0], self[2], self[4])

    @property
    def by(self) -> str:
        """The author of the change."""
        return self[3]

    def __eq__(self, other: object) -> bool:
        return tuple.__eq__(self[:4], other[:4]) if isinstance(other, Change) else NotImplemented

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(self[:4])

    def __repr__(self) -> str:
        return f"Change(name={self.name!r}, old={self.old!r}, new={self.new!r}, by={self.by!r})"

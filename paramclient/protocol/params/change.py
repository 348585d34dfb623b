"""What happens to one parameter of a table."""

from __future__ import annotations

from paramclient.model.params import Held, held_of, param_of
from paramclient.model.values import Param, Value

__all__ = ["Change"]

_new = tuple.__new__  # what the constructor of a tuple ends in, after several times the time


class Change(tuple[str, Held | None, Held | None, str, Value | None, Value | None]):
    """One parameter that appeared, changed its value or went away.

    Each first value makes one, so the parameters in it are made when they are asked for.

    Args:
        name: param_id.
        old: what was known before, or None when the parameter is new.
        new: what is known now, or None when the vehicle no longer has it.
        by: "us" (our own `set`), "us for NAME" (one for which it was told who asked), "vehicle", or "station
            S/C" when another station was heard setting it.
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
        """What was known before, or None when the parameter is new."""
        return None if self[1] is None else param_of(self[0], self[1], self[5])

    @property
    def new(self) -> Param | None:
        """What is known now, or None when the vehicle no longer has it."""
        return None if self[2] is None else param_of(self[0], self[2], self[4])

    @property
    def by(self) -> str:
        """Who did it."""
        return self[3]

    def __eq__(self, other: object) -> bool:
        return tuple.__eq__(self[:4], other[:4]) if isinstance(other, Change) else NotImplemented

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(self[:4])

    def __repr__(self) -> str:
        return f"Change(name={self.name!r}, old={self.old!r}, new={self.new!r}, by={self.by!r})"

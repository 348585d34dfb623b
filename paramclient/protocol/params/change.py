"""Changes of the parameters in a table: values, added and removed parameters."""

from __future__ import annotations

from paramclient.model.params import CompactParam, compact_param, param_of
from paramclient.model.values import Param, WireValue

__all__ = ["Added", "Change", "Changed", "FirstValue", "Removed"]

_new = tuple.__new__  # the constructor of a tuple ends in this call and takes several times as long


class Change(tuple[str, CompactParam | None, CompactParam | None, str, WireValue | None, WireValue | None]):
    """One parameter that appeared, changed its value or was removed.

    Every change is a `Changed`, a `FirstValue`, an `Added` (which is a `FirstValue`) or a `Removed`. After
    `isinstance(change, Changed)`, type checkers know that `old` and `new` are not None.

    The parameters are built only on access, as each first value makes a change.

    Args:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the vehicle no longer has it.
        by: the author: "us" (our own `set`), "us for NAME" (a `set` on behalf of NAME), "vehicle", or
            "station S/C" for a PARAM_SET of another station.
    """

    __slots__ = ()

    def __new__(cls, name: str, old: Param | None, new: Param | None, by: str = "vehicle") -> Change:
        if cls is Change:
            cls = Removed if new is None else FirstValue if old is None else Changed
        before, now = (None if each is None else compact_param(each) for each in (old, new))
        defaults = (None if each is None else each.default for each in (new, old))
        return _new(cls, (name, before, now, by, *defaults))

    @staticmethod
    def between(
        name: str, old: Param | None, new: Param | None, by: str = "vehicle", *, is_added: bool = False
    ) -> Change:
        """Return the change of a parameter as the class that it belongs to.

        Args:
            name, old, new, by: as for `Change`.
            is_added: whether a parameter without `old` is new on the vehicle, rather than received first.
        """
        if new is None:
            return Removed(name, old, new, by)
        if old is not None:
            return Changed(name, old, new, by)
        return (Added if is_added else FirstValue)(name, old, new, by)

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
        members = f"name={self.name!r}, old={self.old!r}, new={self.new!r}, by={self.by!r}"
        return f"{type(self).__name__}({members})"


class Changed(Change):
    """A parameter with another value or type than before."""

    __slots__ = ()

    @property
    def old(self) -> Param:
        """The parameter before."""
        return _present(super().old)

    @property
    def new(self) -> Param:
        """The parameter now."""
        return _present(super().new)


class FirstValue(Change):
    """A parameter that the table did not have before."""

    __slots__ = ()

    @property
    def old(self) -> None:
        """None: the table had no value before."""
        return None

    @property
    def new(self) -> Param:
        """The parameter now."""
        return _present(super().new)


class Added(FirstValue):
    """A parameter that the vehicle has and the table lacked when it was complete last.

    Examples are a parameter that a `set` of `*_ENABLE` reveals, and one outside the vehicle's list that is
    read by name. The first value of each parameter of a table that was never complete is a plain
    `FirstValue`.
    """

    __slots__ = ()


class Removed(Change):
    """A parameter that the vehicle no longer has."""

    __slots__ = ()

    @property
    def old(self) -> Param:
        """The parameter before."""
        return _present(super().old)

    @property
    def new(self) -> None:
        """None: the vehicle no longer has the parameter."""
        return None


def _present(param: Param | None) -> Param:
    assert param is not None  # by the class of the change
    return param

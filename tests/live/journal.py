"""What the suite has changed on the vehicle, and how that is put back.

The state before is written to a file before the first change, so that it can be brought back with
`paramclient restore` even if the suite is ended in a way that leaves it no time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import anyio

from paramclient import Component, ParamSet, write_file
from paramclient.errors import ParamClientError, VehicleArmed
from paramclient.model.values import Param, Value, format_value
from paramclient.protocol.set_results import SetResult
from paramclient.provision.apply_rules import rules_for

HEARTBEAT_TIMEOUT: Final = 3.0
"""Seconds to wait for a heartbeat that says whether the vehicle is armed."""
PUT_BACK_ATTEMPTS: Final = 4
"""How often one value is read and, if it is not the one before, set."""


async def check_disarmed(vehicle: Component) -> None:
    """Raise VehicleArmed unless the vehicle says that it is disarmed."""
    with anyio.move_on_after(HEARTBEAT_TIMEOUT):
        while vehicle.is_armed is None:  # noqa: ASYNC110 - no event shows it
            await anyio.sleep(0.05)
    if vehicle.is_armed is not False:
        says = "is armed" if vehicle.is_armed else "does not say that it is disarmed"
        raise VehicleArmed(
            f"{vehicle.system}/{vehicle.component} {says}; the suite changes nothing then",
            system=vehicle.system,
            component=vehicle.component,
        )


class Journal:
    """The state before, and the names that were changed since.

    Args:
        folder: where the file with the state before is written.

    Attributes:
        before: the vehicle's parameters before the first change, by name.
        changed: what each parameter was before that is changed and not put back, in order of change.
        kind: the vehicle's autopilot.
        file: the state before, as a parameter file.
    """

    def __init__(self, folder: Path) -> None:
        self.before: dict[str, Param] = {}
        self.changed: dict[str, Param] = {}
        self.kind = ""
        self.file = folder / "before.json"

    def begin(self, vehicle: Component, params: Mapping[str, Param]) -> None:
        """Take the state before, and write it to the file."""
        self.kind = vehicle.autopilot
        self.before = dict(params)
        state = ParamSet(
            params,
            system=vehicle.system,
            component=vehicle.component,
            identity=vehicle.identity,
            source="before the live suite",
        )
        write_file(self.file, state)

    async def set(self, vehicle: Component, name: str, value: Value) -> SetResult:
        """Set a parameter as `Component.set` does; what it was before is noted first.

        Raises:
            VehicleArmed: the vehicle is armed or does not say.
            ParamClientError: as from `Component.set`.
        """
        await check_disarmed(vehicle)
        if name not in self.changed:
            before = self.before.get(name)
            self.changed[name] = await vehicle.get(name) if before is None else before
        return await vehicle.set(name, value)

    def note(self, params: Mapping[str, Param]) -> None:
        """Note parameters that something else than `set` is going to change, with their present values."""
        for name, param in params.items():
            self.changed.setdefault(name, self.before.get(name, param))

    async def put_back(self, vehicle: Component) -> list[str]:
        """Set everything that was changed to what it was before, the last change first.

        Returns:
            One sentence for each parameter that could not be put back. It stays in `changed`.
        """
        problems: list[str] = []
        names = list(reversed(self.changed))
        while names:
            # members of a group are only there while its switch is on: the switch waits for them
            together = [names.pop(0)]
            while names and not _is_switch(together[0]) and not _is_switch(names[0]):
                together.append(names.pop(0))
            async with anyio.create_task_group() as tasks:
                for name in together:
                    tasks.start_soon(self._set_back, vehicle, self.changed[name], problems)
        return problems

    def differences(self, params: Mapping[str, Param]) -> tuple[list[str], list[str]]:
        """Compare the state after with the state before.

        Returns:
            What differs although it should not, in words, and the names that the vehicle changes by itself.
        """
        wrong: list[str] = []
        changed: list[str] = []
        for name in sorted(self.before.keys() | params.keys()):
            old, new = self.before.get(name), params.get(name)
            if old is not None and new is not None:
                is_same, may_differ = old.same_value(new), self.moves_by_itself(name)
            else:
                is_same, may_differ = False, self.appears_and_disappears(name)
            if is_same:
                continue
            if may_differ:
                changed.append(name)
                continue
            was = "absent" if old is None else format_value(old.value, old.type)
            now = "absent" if new is None else format_value(new.value, new.type)
            wrong.append(f"{name} was {was}, is {now}")
        return wrong, changed

    def moves_by_itself(self, name: str) -> bool:
        """Whether a vehicle of this kind may give the parameter another value without requests.

        Counters, calibration and what is measured or written by the vehicle alone do, by the list that the
        list of `apply` has.
        """
        return self._category(name) in _MOVING

    def appears_and_disappears(self, name: str) -> bool:
        """Whether a vehicle of this kind may list the parameter or not, without requests.

        PX4 lists what its firmware has used since the start: the ids of sensors that are not there are listed
        after some starts, and not after others (measured).
        """
        return self.kind == "px4" and self._category(name) in (*_MOVING, "hardware")

    def _category(self, name: str) -> str:
        rule = rules_for(self.kind).left_out(name)
        return "" if rule is None else rule.category

    async def _set_back(self, vehicle: Component, param: Param, problems: list[str]) -> None:
        """Set one parameter until a read proves it."""
        problem = ""
        for _ in range(PUT_BACK_ATTEMPTS):
            try:
                if (held := await vehicle.get(param.name)).same_value(param):
                    self.changed.pop(param.name, None)
                    return
                problem = f"the vehicle holds {format_value(held.value, held.type)}"
                await vehicle.set(param.name, param.value)
            except ParamClientError as error:
                problem = str(error)
        problems.append(f"{param.name} could not be put back to {param.value!r}: {problem}")


_MOVING = ("counter", "calibration", "measured", "read-only")


def _is_switch(name: str) -> bool:
    return name.endswith(("_ENABLE", "_ENABLED"))

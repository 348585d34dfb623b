"""`for_each`: one call for each of several vehicles, concurrently."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import anyio

from paramclient.client.component import Component
from paramclient.errors import ParamClientError
from paramclient.provision.planning import Rows

__all__ = ["FleetResult", "for_each"]


Outcome = TypeVar("Outcome", bound=Rows)


@dataclass(frozen=True, slots=True)
class FleetResult(Generic[Outcome]):
    """The results of one call for each vehicle.

    Attributes:
        results: by (system, component), the result for each vehicle.
        errors: by (system, component), the error that the call raised for a vehicle.
    """

    results: Mapping[tuple[int, int], Outcome]
    errors: Mapping[tuple[int, int], ParamClientError]

    @property
    def complete(self) -> bool:
        """Whether every call has a result, and every result is complete."""
        return not self.errors and all(result.complete for result in self.results.values())


async def for_each(
    components: Iterable[Component], call: Callable[[Component], Awaitable[Outcome]]
) -> FleetResult[Outcome]:
    """Make a call for each vehicle, concurrently; a failure of one does not stop the others.

    The call is `plan`, `apply` or `restore`::

        fleet = await for_each(vehicles, lambda vehicle: apply(vehicle, {"RTL_ALT": 2500}, reboot=True))
    """
    results: dict[tuple[int, int], Outcome] = {}
    errors: dict[tuple[int, int], ParamClientError] = {}

    async def run(component: Component) -> None:
        address = component.system, component.component
        try:
            results[address] = await call(component)
        except ParamClientError as error:
            errors[address] = error

    async with anyio.create_task_group() as running:
        for component in components:
            running.start_soon(run, component)
    return FleetResult(dict(sorted(results.items())), dict(sorted(errors.items())))

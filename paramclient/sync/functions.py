"""The public functions that take a client or a component, with calls that block.

Each has the arguments and the result of the asynchronous function of the same name, in
`paramclient.provision`, `paramclient.metadata` and `paramclient.diagnosis`. Callbacks are called in the
thread of the caller: they may print, ask, or call the client. An exception of a callback ends the call.
Ctrl-C ends a call like a cancellation of the asynchronous function: values that were written stay on the
vehicle.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Awaitable, Callable, Iterable, Mapping
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, TypeAlias, TypeVar

import anyio
import anyio.from_thread
import anyio.lowlevel

from paramclient import diagnosis, metadata, provision
from paramclient.client.component import Component as AsyncComponent
from paramclient.diagnosis import VehicleReport
from paramclient.errors import UsageError
from paramclient.model.paramset import ParamSet
from paramclient.model.renames import Renames
from paramclient.protocol.addresses import Address
from paramclient.provision import ApplyProgress, FleetApplied, FleetVerified, ParamInfo
from paramclient.sync.blocking import Component, ParamClient
from paramclient.sync.client_thread import ClientThread
from paramclient.sync.wrappers import thread_of, wrapped_by

__all__ = [
    "Wanted",
    "apply",
    "apply_all",
    "apply_extended",
    "check_vehicle",
    "load_extended_state",
    "metadata_of",
    "prepare",
    "restore",
    "restore_all",
    "restore_extended",
    "verify",
    "verify_all",
    "verify_extended",
]

Wanted: TypeAlias = ParamSet | Mapping[tuple[int, int], ParamSet] | Callable[[Component], ParamSet]
"""The wanted parameters of several vehicles: one set for all, or a set for each by address or by a call."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Value = TypeVar("Value")

CallBack: TypeAlias = Callable[[Callable[[], object]], None]
"""Has a function called in the thread of the caller."""


def _blocking(
    function: Callable[Concatenate[AsyncComponent, Arguments], Awaitable[Result]],
) -> Callable[Concatenate[Component, Arguments], Result]:
    """Return a function that takes a blocking component, and waits for the result."""

    @wraps(function)
    def call(component: Component, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        callbacks = {name: kwargs.pop(name) for name in _FORMS if name in kwargs}
        work = partial(function, wrapped_by(component), *args, **kwargs)
        return _run(thread_of(component), work, callbacks)

    return call


prepare = _blocking(provision.prepare)
apply = _blocking(provision.apply)
verify = _blocking(provision.verify)
restore = _blocking(provision.restore)
apply_extended = _blocking(provision.apply_extended)
verify_extended = _blocking(provision.verify_extended)
restore_extended = _blocking(provision.restore_extended)
load_extended_state = _blocking(provision.load_extended_state)
metadata_of = _blocking(metadata.metadata_of)


def apply_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    renames: Renames | None = None,
    durable: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`apply` to several vehicles concurrently. A failure of one vehicle does not stop the others.

    Arguments as of `paramclient.provision.apply_all`; all functions are called in the thread of the caller.

    Raises:
        UsageError: `wanted` has no set for one of the vehicles, or the vehicles belong to several clients;
            nothing was sent to any vehicle.
    """
    fleet = _Fleet(components)
    if fleet.thread is None:
        return FleetApplied({}, {})
    work = partial(
        provision.apply_all,
        fleet.wrapped,
        fleet.wanted(wanted),
        include=include if isinstance(include, str) else tuple(include),
        info=None if info is None else fleet.for_each(info),
        reboot=reboot,
        allow_armed=allow_armed,
        skip_invalid=skip_invalid,
        force=force,
        renames=renames,
        durable=durable,
        backup=None if backup is None else fleet.for_each(backup),
        timeout=timeout,
        author=author,
    )
    return _run(fleet.thread, work, fleet.callbacks(progress, before_writing))


def verify_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> FleetVerified:
    """`verify` several vehicles concurrently.

    Arguments and errors as in `apply_all`.
    """
    fleet = _Fleet(components)
    if fleet.thread is None:
        return FleetVerified({}, {})
    work = partial(
        provision.verify_all,
        fleet.wrapped,
        fleet.wanted(wanted),
        include=include if isinstance(include, str) else tuple(include),
        info=None if info is None else fleet.for_each(info),
        force=force,
        renames=renames,
    )
    return _run(fleet.thread, work, {})


def restore_all(
    components: Iterable[Component],
    states: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`restore` several vehicles concurrently. A failure of one vehicle does not stop the others.

    Arguments as of `paramclient.provision.restore_all`; all functions are called in the thread of the caller.

    Raises:
        UsageError: `states` has no set for one of the vehicles, or the vehicles belong to several clients;
            nothing was sent to any vehicle.
    """
    fleet = _Fleet(components)
    if fleet.thread is None:
        return FleetApplied({}, {})
    work = partial(
        provision.restore_all,
        fleet.wrapped,
        fleet.wanted(states),
        include=include if isinstance(include, str) else tuple(include),
        info=None if info is None else fleet.for_each(info),
        reboot=reboot,
        allow_armed=allow_armed,
        force=force,
        backup=None if backup is None else fleet.for_each(backup),
        timeout=timeout,
        author=author,
    )
    return _run(fleet.thread, work, fleet.callbacks(progress, before_writing))


def check_vehicle(
    client: ParamClient,
    component: Component,
    *,
    timeout: float = 60.0,
    progress: Callable[[str], None] | None = None,
) -> VehicleReport:
    """Measure what a vehicle serves and how fast, and compare it with what is usual. Writes nothing.

    Arguments, result and errors as of `paramclient.diagnosis.check_vehicle`.
    """
    work = partial(diagnosis.check_vehicle, wrapped_by(client), wrapped_by(component), timeout=timeout)
    return _run(thread_of(client), work, {"progress": progress})


class _Fleet:
    """The components of one call.

    Args:
        components: blocking components.

    Attributes:
        thread: the thread of their client; None if there are no components.
        wrapped: the asynchronous components.

    Raises:
        UsageError: the components belong to several clients.
    """

    def __init__(self, components: Iterable[Component]) -> None:
        self._components = list(components)
        threads = {thread_of(each) for each in self._components}
        if len(threads) > 1:
            raise UsageError(
                f"the vehicles belong to {len(threads)} clients; make one call for those of each client"
            )
        self.thread: ClientThread | None = threads.pop() if threads else None
        self.wrapped = [wrapped_by(each) for each in self._components]

    def for_each(self, function: Callable[[Component], Value]) -> Callable[[AsyncComponent], Value]:
        """Call a function for each component now, in this thread; return a function that has the results."""
        values = {_address_of(each): function(each) for each in self._components}
        return lambda component: values[_address_of(component)]

    def wanted(self, wanted: Wanted) -> provision.Wanted:
        """Return the wanted parameters for the asynchronous function."""
        return wanted if isinstance(wanted, ParamSet | Mapping) else self.for_each(wanted)

    def callbacks(
        self,
        progress: Callable[[Component, ApplyProgress], None] | None,
        before_writing: Callable[[Component], object] | None,
    ) -> dict[str, Callable[..., object] | None]:
        """Return the callbacks of a set-up by the name of their argument."""
        return {
            "progress": None if progress is None else self._with_component(progress),
            "before_writing": None if before_writing is None else self._with_component(before_writing),
        }

    def _with_component(self, callback: Callable[..., object]) -> Callable[..., object]:
        """Return a callback whose first argument is the blocking component."""
        components = {_address_of(each): each for each in self._components}
        return lambda component, *values: callback(components[_address_of(component)], *values)


def _address_of(component: Component | AsyncComponent) -> Address:
    return component.system, component.component


def _run(
    thread: ClientThread,
    work: Callable[..., Awaitable[Result]],
    callbacks: Mapping[str, Any],
) -> Result:
    """Run an asynchronous function in the thread of a client, and its callbacks in that of the caller."""
    given = {name: callback for name, callback in callbacks.items() if callback is not None}
    if not given:
        return thread.call(work)

    async def run(progress: CallBack) -> Result:
        return await work(**{name: _FORMS[name](progress, each) for name, each in given.items()})

    def call(callback: Callable[[], object]) -> None:
        callback()

    return thread.call_reporting(run, call)


def _reporter(call_back: CallBack, progress: Callable[..., object]) -> Callable[..., None]:
    """Return a function that has `progress` called in the thread of the caller, and does not wait for it."""
    return lambda *values: call_back(partial(progress, *values))


def _question(call_back: CallBack, before_writing: Callable[..., object]) -> Callable[..., Awaitable[None]]:
    """Return an asynchronous function that waits for `before_writing` in the thread of the caller."""

    async def ask(*values: object) -> None:
        answered = anyio.Event()
        token = anyio.lowlevel.current_token()

        def answer() -> None:
            if inspect.isawaitable(result := before_writing(*values)):
                if inspect.iscoroutine(result):
                    result.close()
                raise UsageError("before_writing of a blocking call must not be asynchronous")
            anyio.from_thread.run_sync(answered.set, token=token)

        call_back(answer)
        await answered.wait()

    return ask


_FORMS: dict[str, Callable[[CallBack, Callable[..., object]], Any]] = {
    "progress": _reporter,
    "before_writing": _question,
}
"""The arguments that are functions of the caller; each with what makes its asynchronous form."""

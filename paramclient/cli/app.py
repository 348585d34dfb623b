"""The main function of the command line: subcommands, arguments, errors, exit codes, signals."""

from __future__ import annotations

import asyncio
import inspect
import logging
import signal
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Final

import anyio
from cyclopts import App, CycloptsError, Parameter

from paramclient.cli.exit_codes import ExitCode, code_of, text_of
from paramclient.cli.output import printable, report, say
from paramclient.errors import ParamClientError
from paramclient.version import __version__

__all__ = ["run"]


def run(arguments: Sequence[str]) -> int:
    """Run the command line with these arguments; return its exit code.

    Raises:
        KeyboardInterrupt: Ctrl-C while nothing is awaited, or a second Ctrl-C.
        BrokenPipeError: the reader of stdout has closed it.
    """
    if _shows_help(arguments):
        _load(_app)
    with _warnings_shown() as printer:
        try:
            command, bound, _ = _app.parse_args(arguments, exit_on_error=False, print_error=False)
            if _is_verbose(bound.arguments):
                printer.show_steps()
            call = partial(command, *bound.args, **bound.kwargs)
            work = call if inspect.iscoroutinefunction(command) else call()
            # a subcommand that has asked the user something returns the function to await after that
            code = anyio.run(_until_signal, work) if callable(work) else work
        except CycloptsError as error:
            report(str(error))
            return ExitCode.USAGE
        except ParamClientError as error:
            report(text_of(error))
            return code_of(error)
        except BrokenPipeError:
            raise
        except OSError as error:  # of stdout: the library translates all others into its own errors
            report(f"cannot write the output: {error.strerror}")
            return ExitCode.INCOMPLETE
    return code or ExitCode.DONE


def _shows_help(arguments: Sequence[str]) -> bool:
    """Return whether help is printed: with --help, and without a subcommand."""
    is_group = len(arguments) == 1 and arguments[0] in ("cache", "fleet", "signing")
    return not arguments or is_group or any(word in _app.help_flags for word in arguments)


def _load(app: App) -> None:
    """Import all subcommands, so that the help can describe each of them."""
    for name in app:
        _load(app[name])


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command in an orderly way."""


async def _until_signal(work: Callable[[], Awaitable[int | None]]) -> int | None:
    """Await `work` and return its exit code; on a signal, cancel it and return 128 plus the signal number.

    A second signal ends the process immediately.
    """
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    received: list[int] = []

    with anyio.CancelScope() as scope:

        def end(number: int, _: FrameType | None) -> None:
            received.append(number)
            for each in _SIGNALS:
                signal.signal(each, signal.SIG_DFL)
            loop.call_soon_threadsafe(scope.cancel)

        for number in _SIGNALS:
            signal.signal(number, end)  # not by the event loop, which has no signal handlers on Windows
        try:
            return await work()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    return 128 + received[0]


class _LogPrinter(logging.Handler):
    """Prints warnings of the library on stderr, and with --verbose each step."""

    def show_steps(self) -> None:
        """Print each step from now on."""
        self.setLevel(logging.DEBUG)
        _logger.setLevel(logging.DEBUG)

    def emit(self, record: logging.LogRecord) -> None:
        """Print a log record."""
        if record.levelno >= logging.WARNING:
            report(f"{record.levelname.lower()}: {record.getMessage()}")
        else:
            name = record.name.removeprefix("paramclient.")
            say(printable(f"{record.relativeCreated / 1000:8.3f} {name}: {record.getMessage()}"))


_logger: Final = logging.getLogger("paramclient")


@contextmanager
def _warnings_shown() -> Iterator[_LogPrinter]:
    handler = _LogPrinter(logging.WARNING)
    level = _logger.level
    _logger.addHandler(handler)
    try:
        yield handler
    finally:
        _logger.removeHandler(handler)
        _logger.setLevel(level)


def _is_verbose(arguments: Mapping[str, object]) -> bool:
    options = arguments.get("options")
    return bool(arguments.get("verbose", getattr(options, "verbose", False)))


def _examples(*lines: str) -> str:
    return "\n".join(["Examples:", *(f"  paramclient {line}" for line in lines)])


_EXIT_CODES: Final = """

Exit codes: 0 done; 1 refused, incomplete, different; 2 usage; 3 no vehicle or no answer; 4 link; 5 cache."""
"""The last lines of the help."""

_app: Final = App(
    name="paramclient",
    help="Fetch, get and set the parameters of MAVLink vehicles, and show them later without a link.",
    help_epilogue=_examples(
        "fetch sim:px4",
        "get udpin:0.0.0.0:14550 MC_ROLL_P",
        "set udpin:0.0.0.0:14550 MC_ROLL_P 6.5",
        "show",
    )
    + _EXIT_CODES,
    version=f"paramclient {__version__}",
    default_parameter=Parameter(negative=()),
    help_format="plaintext",
    version_format="plaintext",
)
_cache: Final = App(
    name="cache",
    help="Show, remove or copy tables in the cache. Needs no link.",
    help_epilogue=_examples(
        "cache list",
        "cache history 1 MC_ROLL_P",
        "cache path",
        "cache remove 1",
        "cache copy field.sqlite3 postgresql://me@office/fleet",
    ),
)

_signing: Final = App(
    name="signing",
    help="Set and remove the signing key of a vehicle.",
    help_epilogue=_examples(
        "signing setup udpin:0.0.0.0:14550 --signing-key vehicle.key",
        "signing disable udpin:0.0.0.0:14550 --signing-key vehicle.key",
    ),
)
_fleet: Final = App(
    name="fleet",
    help="Compare the vehicles in the cache. Needs no link.",
    help_epilogue=_examples("fleet diff BAT1_N_CELLS 'COM_ARM_*'", "fleet diff quad.params"),
)

# By name: a subcommand loads only its own modules, which halves the time until it opens its link.

_app.command(
    "paramclient.cli.parameters:fetch",
    name="fetch",
    help_epilogue=_examples(
        "fetch udpin:0.0.0.0:14550", "fetch sim:px4 --json", "fetch tcp:127.0.0.1:5760 --system 3"
    ),
)
_app.command(
    "paramclient.cli.parameters:get",
    name="get",
    usage="Usage: paramclient get [OPTIONS] URL NAME [NAME...]",
    help_epilogue=_examples("get udpin:0.0.0.0:14550 MC_ROLL_P MC_PITCH_P", "get sim:ardupilot RTL_ALT"),
)
_app.command(
    "paramclient.cli.parameters:set_",
    name="set",
    usage="Usage: paramclient set [OPTIONS] URL NAME VALUE|NAME=VALUE [NAME VALUE|NAME=VALUE...]",
    help_epilogue=_examples(
        "set udpin:0.0.0.0:14550 MC_ROLL_P 6.5 MC_PITCH_P 6.5",
        "set udpin:0.0.0.0:14550 FLTMODE1=Loiter --metadata apm.pdef.xml",
    ),
)
_app.command(
    "paramclient.cli.parameters:watch",
    name="watch",
    usage="Usage: paramclient watch [OPTIONS] URL [NAME...]",
    help_epilogue=_examples("watch udpin:0.0.0.0:14550", "watch udpin:0.0.0.0:14550 MC_ROLL_P --json"),
)
_app.command(
    "paramclient.cli.link:link",
    name="link",
    help_epilogue=_examples("link udpin:0.0.0.0:14550", "link udpin:0.0.0.0:14550 --seconds 10 --json"),
)
_app.command(
    "paramclient.cli.check:check",
    name="check",
    help_epilogue=_examples(
        "check udpin:0.0.0.0:14550",
        "check serial:/dev/ttyUSB0:57600 --report check.md",
        "check sim:px4 --json",
    ),
)
_app.command(
    "paramclient.cli.offline:show",
    name="show",
    usage="Usage: paramclient show [OPTIONS] [FILE|VEHICLE [NAME...]]",
    help_epilogue=_examples("show", "show 1", "show 1 MC_ROLL_P", "show 00020000 --json", "show quad.params"),
)
_app.command(
    "paramclient.cli.diff:diff",
    name="diff",
    usage="Usage: paramclient diff [OPTIONS] A B",
    help_epilogue=_examples(
        "diff before.params after.params",
        "diff quad.param udpin:0.0.0.0:14550 --only 'MC_*'",
        "diff 1 2 --base defaults",
    ),
)
_app.command(
    "paramclient.cli.history:history",
    name="history",
    usage="Usage: paramclient history [OPTIONS] VEHICLE [NAME]",
    help_epilogue=_examples("history 1 MC_ROLL_P", "history 1 --since '2h ago'", "history 1 --snapshots"),
)
_app.command(_fleet)
_app.command(
    "paramclient.cli.save:save",
    name="save",
    usage="Usage: paramclient save [OPTIONS] URL|VEHICLE FILE",
    help_epilogue=_examples(
        "save udpin:0.0.0.0:14550 quad.yaml",
        "save sim:ardupilot tuned.param --changed",
        "save 1 before.params --all",
    ),
)
_app.command(
    "paramclient.cli.setup:apply",
    name="apply",
    usage="Usage: paramclient apply [OPTIONS] URL FILE",
    help_epilogue=_examples(
        "apply udpin:0.0.0.0:14550 quad.params --dry-run",
        "apply udpin:0.0.0.0:14550 quad.params --reboot --backup before.yaml",
        "apply udpin:0.0.0.0:14550 fleet.param --all --overlay 'own/{system}.param'",
        "apply sim:ardupilot copter.param",
    ),
)
_app.command(
    "paramclient.cli.setup:verify",
    name="verify",
    usage="Usage: paramclient verify [OPTIONS] URL FILE",
    help_epilogue=_examples(
        "verify udpin:0.0.0.0:14550 quad.params", "verify udpin:0.0.0.0:14550 fleet.param --all --expect 5"
    ),
)
_app.command(
    "paramclient.cli.setup:restore",
    name="restore",
    usage="Usage: paramclient restore [OPTIONS] URL [WHEN|FILE]",
    help_epilogue=_examples(
        "restore udpin:0.0.0.0:14550 --dry-run",
        "restore udpin:0.0.0.0:14550 '2h ago'",
        "restore udpin:0.0.0.0:14550 before.yaml",
    ),
)
_app.command(
    "paramclient.cli.logs:import_",
    name="import",
    usage="Usage: paramclient import [OPTIONS] FILE [FILE...]",
    help_epilogue=_examples("import flight.tlog", "import logs/*.tlog --json"),
)
_app.command(
    "paramclient.cli.serve:serve",
    name="serve",
    usage="Usage: paramclient serve [OPTIONS] LINK [LINK...]",
    help_epilogue=_examples(
        "serve udpin:0.0.0.0:14550",
        "serve serial:/dev/ttyACM0:57600 udpin:0.0.0.0:14550 --listen 127.0.0.1:0",
    ),
)
_app.command(
    "paramclient.cli.token:token",
    name="token",
    help_epilogue=_examples("token anna --file tokens", "token wall-display --file tokens --read"),
)
_app.command(_cache)
_app.command("paramclient.cli.ports:ports", name="ports", help_epilogue=_examples("ports", "ports --json"))
_app.command(
    "paramclient.cli.simulate:sim",
    name="sim",
    help_epilogue=_examples(
        "sim px4 --link udpout:127.0.0.1:14550 --loss 0.05 --seed 1", "sim ardupilot --link udpin:127.0.0.1:0"
    ),
)
_app.command(_signing)
_signing.command("paramclient.cli.signing:setup", name="setup")
_signing.command("paramclient.cli.signing:disable", name="disable")
_cache.command("paramclient.cli.offline:cache_list", name="list")
_cache.command(
    "paramclient.cli.history:history",
    name="history",
    usage="Usage: paramclient cache history [OPTIONS] VEHICLE [NAME]",
)
_cache.command("paramclient.cli.offline:cache_path", name="path")
_cache.command("paramclient.cli.offline:cache_remove", name="remove")
_cache.command("paramclient.cli.offline:cache_copy", name="copy")
_fleet.command(
    "paramclient.cli.fleet:fleet_diff",
    name="diff",
    usage="Usage: paramclient fleet diff [OPTIONS] NAME...|FILE",
    help_epilogue=_examples("fleet diff BAT1_N_CELLS 'COM_ARM_*'", "fleet diff quad.params --json"),
)

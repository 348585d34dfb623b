"""The main function of the command line: subcommands, arguments, errors, exit codes, signals."""

from __future__ import annotations

import asyncio
import inspect
import logging
import re
import signal
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, reduce
from types import FrameType
from typing import Final

import anyio
from cyclopts import App, CycloptsError, MissingArgumentError, Parameter, UnusedCliTokensError

from paramclient.cli.output import STDIN, ExitCode, code_of, report, say, text_of
from paramclient.errors import ParamClientError
from paramclient.version import __version__

_LINE_BREAK: Final = re.compile(r"(?<=\S)\n( {8})?(?=\S)")
"""A line break within a paragraph of a docstring, of which help would make one on every terminal."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


def run(arguments: Sequence[str]) -> int:
    """Run the command line with these arguments; return its exit code.

    Raises:
        KeyboardInterrupt: Ctrl-C while nothing is awaited, or a second Ctrl-C.
        BrokenPipeError: the reader of stdout has closed it.
    """
    # groups print help where no subcommand follows
    if not arguments or not {"--help", "-h", "cache", "metadata", "signing"}.isdisjoint(arguments):
        for _, app in subcommands():  # imports all of them, so that the help can describe each
            app.default_command.__doc__ = _LINE_BREAK.sub(" ", inspect.getdoc(app.default_command) or "")
    with _messages_shown(verbose=not {"--verbose", "-v"}.isdisjoint(arguments)):
        try:
            words = [STDIN if word == "-" else word for word in arguments]
            command, bound, _ = _app.parse_args(words, exit_on_error=False, print_error=False)
            words = ["-" if word == STDIN else word for word in bound.args]
            named = {name: "-" if value == STDIN else value for name, value in bound.kwargs.items()}
            call = partial(command, *words, **named)
            code = anyio.run(_until_signal, call) if inspect.iscoroutinefunction(command) else call()
        except CycloptsError as error:
            text = str(error)
            if isinstance(error, MissingArgumentError):
                text += f" {dict(subcommands())[' '.join(error.command_chain or ())].usage}"
            elif isinstance(error, UnusedCliTokensError):
                text = f"not expected: {' '.join(error.unused_tokens or ())}"
            report(text)
            return ExitCode.USAGE
        except ParamClientError as error:
            report(text_of(error, takes_all=arguments[0] != "signing"))
            return code_of(error)
        except BrokenPipeError:
            raise
        except SystemExit:  # from rich: the reader of the help, such as head, has closed it
            code = ExitCode.DONE
        except OSError as error:  # of stdout: the library translates all others into its own errors
            report(f"cannot write the output: {error.strerror}")
            return ExitCode.INCOMPLETE
    return code or ExitCode.DONE


def subcommands(*words: str) -> Iterator[tuple[str, App]]:
    """Yield each subcommand with its name, such as `cache list`."""
    app = reduce(App.__getitem__, words, _app)
    names = [name for name in app if not name.startswith("-")]
    if not names:
        yield " ".join(words), app
    for name in names:
        yield from subcommands(*words, name)


@contextmanager
def on_end_signal(end: Callable[[], object]) -> Iterator[list[int]]:
    """Call `end` in the event loop on SIGINT or SIGTERM. A second signal ends the process immediately.

    Yields:
        the number of the signal, after it.
    """
    loop, received = asyncio.get_running_loop(), list[int]()

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        loop.call_soon_threadsafe(end)

    # not by the event loop, which has no signal handlers on Windows
    before = [(number, signal.signal(number, receive)) for number in _SIGNALS]
    try:
        yield received
    finally:
        for each in before:
            signal.signal(*each)


async def _until_signal(work: Callable[[], Awaitable[int | None]]) -> int | None:
    """Await `work` and return its exit code; on a signal, cancel it and return 128 plus the signal number."""
    with anyio.CancelScope() as scope, on_end_signal(scope.cancel) as received:
        return await work()
    return 128 + received[0]


class _LogPrinter(logging.Handler):
    """Prints warnings of the library on stderr, and with --verbose each step."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a log record."""
        if record.levelno >= logging.WARNING:
            report(f"{record.levelname.lower()}: {record.getMessage()}")
        else:
            say(f"{record.relativeCreated / 1000:8.3f} {record.name}: {record.getMessage()}")


@contextmanager
def _messages_shown(*, verbose: bool) -> Iterator[None]:
    logger = logging.getLogger("paramclient")
    level, handler = logger.level, _LogPrinter(logging.DEBUG if verbose else logging.WARNING)
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if verbose else level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def _examples(*lines: str) -> str:
    return "\n".join(["Examples:", *(f"  paramclient {line}" for line in lines)])


_EXIT_CODES: Final = """

Exit codes: 0 done; 1 refused, incomplete, different; 2 usage; 3 no vehicle or no answer; 4 link; 5 cache."""
"""The last lines of the help."""

_app: Final = App(
    name="paramclient",
    help="Fetch, get and set the parameters of MAVLink vehicles, and show them later without a link.",
    help_epilogue=_examples("fetch sim:px4", "set udpin:0.0.0.0:14550 MC_ROLL_P 6.5", "show") + _EXIT_CODES,
    version=f"paramclient {__version__}",
    default_parameter=Parameter(negative=(), show_default=False),
    help_format="plaintext",
    version_format="plaintext",
)
_cache: Final = App(name="cache", help="List or remove tables in the cache. Needs no link.", help_epilogue="")
_signing: Final = App(name="signing", help="Set and remove the signing key of a vehicle.", help_epilogue="")
_metadata: Final = App(name="metadata", help="Add, list or remove metadata of parameters.", help_epilogue="")


def _add(group: App, function: str, arguments: str = "", *examples: str) -> None:
    """Add a subcommand, named like its function without the group and a trailing underscore.

    The function is named and not imported: a subcommand loads only its own modules, which halves the time
    until it opens its link.

    Args:
        group: the group, or the whole command line.
        function: module of `paramclient.cli`, and function.
        arguments: the arguments in the usage line.
        examples: arguments of the examples in the help.
    """
    name = function.partition(":")[2].removesuffix("_").removeprefix(f"{group.name[0]}_")
    words = name if group is _app else f"{group.name[0]} {name}"
    group.command(
        f"paramclient.cli.{function}",
        name=name,
        usage=f"Usage: paramclient {words} [OPTIONS] {arguments}".rstrip(),
        help_epilogue=_examples(*(f"{words} {each}".rstrip() for each in examples)) if examples else "",
    )


_add(_app, "read_commands:fetch", "URL [NAME...]", "sim:px4 'MC_*'", "tcp:127.0.0.1:5760 --vehicle 3 --json")
_add(_app, "read_commands:get", "URL NAME [NAME...]", "udpin:0.0.0.0:14550 MC_ROLL_P 'MC_PITCH*'")
_add(_app, "set_command:set_", "URL NAME VALUE [NAME VALUE...]", "sim:px4 MC_ROLL_P 6.5 MC_PITCH_P 6.5")
_add(_app, "apply:reset", "URL NAME [NAME...]|--all", "sim:ardupilot 'RTL_*' --dry-run")
_add(_app, "read_commands:watch", "URL [NAME...]", "udpin:0.0.0.0:14550 MC_ROLL_P --json")
_add(_app, "link:link", "URL", "udpin:0.0.0.0:14550 --seconds 10 --json")
_add(_app, "check:check", "URL", "udpin:0.0.0.0:14550")
_add(_app, "show:show", "[FILE|VEHICLE [NAME...]]", "", "1 MC_ROLL_P", "quad.params")
_add(_app, "sources:diff", "LEFT RIGHT", "quad.param tcp:127.0.0.1:5760 --only 'MC_*'", "1 2 --base defaults")
_add(_app, "cached:history", "VEHICLE [NAME...]", "1 'MC_*' --since '2h ago'", "1 --snapshots")
_add(_app, "show:search", "WORD [WORD...]", "roll rate", "geofence --metadata apm.pdef.xml")
_add(_app, "show:info", "NAME", "MC_ROLL_P", "rtl_alt --vehicle 1 --json")
_add(_app, "sources:save", "URL|LOG|VEHICLE FILE", "udpin:0.0.0.0:14550 quad.params", "1 own.param --changed")
_add(_app, "apply:apply", "URL FILE", "sim:px4 quad.params --dry-run", "sim:px4 {system}.param --vehicle all")
_add(_app, "apply:restore", "URL [WHEN|FILE]", "sim:px4 --dry-run", "udpin:0.0.0.0:14550 '2h ago'")
_add(_app, "cached:import_", "FILE [FILE...]", "flight.tlog")
_add(_app, "serve:serve", "LINK [LINK...]", "serial:/dev/ttyACM0:57600 --listen 127.0.0.1:0")
_add(_app, "serve:token", "NAME --file FILE", "anna --file tokens", "wall-display --file tokens --read")
_add(_app, "link:ports")
_add(_app, "serve:sim", "VEHICLE", "px4 --link udpout:127.0.0.1:14550", "'ardupilot?loss=0.05&seed=1'")
for _each in (_cache, _metadata, _signing):
    _app.command(_each)
_add(_signing, "signing:setup", "URL", "udpin:0.0.0.0:14550 --signing-key vehicle.key")
_add(_signing, "signing:disable", "URL", "udpin:0.0.0.0:14550 --signing-key vehicle.key")
_add(_metadata, "metadata:metadata_add", "FILE", "apm.pdef.xml --firmware 4.6")
_add(_metadata, "metadata:metadata_list")
_add(_metadata, "metadata:metadata_remove", "VEHICLE", "copter --firmware 4.6")
_add(_cache, "cached:cache_list")
_add(_cache, "cached:cache_remove", "VEHICLE", "1")

"""Candidates of shell completion: subcommands, options, and names of vehicles and parameters in the cache.

The shell starts the command at each press of the completion key, with `COMPLETION_VARIABLE` in the
environment. A completion takes at most 0.3 s. Imports are therefore inside the functions that need them, and
the options of the subcommands are read from a file that is written once for each version of the command (see
`completion_table`).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeAlias

__all__ = ["COMPLETION_VARIABLE", "POSITIONALS", "candidates", "main", "read_table", "split_line"]

COMPLETION_VARIABLE: Final = "_PARAMCLIENT_COMPLETE"
"""The environment variable that asks for candidates. Its value is the name of the shell."""
TABLES_READ_MAX: Final = 8
"""Cached tables of which the parameter names are read, the latest first: each takes some milliseconds."""

Candidate: TypeAlias = tuple[str, str]
"""A word and its description, which may be empty."""
Table: TypeAlias = dict[str, dict[str, Any]]
"""Subcommands by name: `help`, and `options` by name with `help`, `takes` and `choices`."""

LINK, NAME, VALUE, VEHICLE, SOURCE, FILE, TEXT = "link", "name", "value", "vehicle", "source", "file", "text"
"""Kinds of arguments. A source is a file, a link or a vehicle in the cache."""

POSITIONALS: Final[dict[str, tuple[str, ...]]] = {
    "fetch": (LINK,),
    "get": (LINK, NAME),
    "set": (LINK, NAME, VALUE),
    "watch": (LINK, NAME),
    "reset": (LINK, NAME),
    "link": (LINK,),
    "check": (LINK,),
    "show": (VEHICLE, NAME),
    "diff": (SOURCE, SOURCE),
    "history": (VEHICLE, NAME),
    "search": (TEXT,),
    "info": (NAME,),
    "save": (SOURCE, FILE),
    "apply": (LINK, SOURCE),
    "verify": (LINK, SOURCE),
    "restore": (LINK, FILE),
    "import": (FILE,),
    "serve": (LINK,),
    "token": (TEXT,),
    "ports": (),
    "sim": (TEXT,),
    "cache list": (),
    "cache history": (VEHICLE, NAME),
    "cache add": (VEHICLE, FILE),
    "cache path": (),
    "cache name": (VEHICLE, TEXT),
    "cache remove": (VEHICLE,),
    "cache copy": (FILE, FILE),
    "metadata add": (FILE,),
    "metadata list": (),
    "metadata remove": (TEXT,),
    "fleet diff": (NAME,),
    "signing setup": (LINK,),
    "signing disable": (LINK,),
}
"""Kinds of the arguments of each subcommand. The last one is that of all further ones; name and value of
`set` take turns."""
_OPTION_KINDS: Final = {"--vehicle": VEHICLE, "--only": NAME, "--system": "system", "--base": SOURCE}
_LINKS: Final = (
    ("udpin:0.0.0.0:14550", "a vehicle that sends to this port"),
    ("udpout:", "HOST:PORT to send to"),
    ("tcp:", "HOST:PORT to connect to"),
    ("tcpin:", "HOST:PORT to accept connections at"),
    ("serial:", "DEVICE:BAUD"),
    ("sim:px4", "a simulated PX4"),
    ("sim:ardupilot", "a simulated ArduPilot"),
    ("replay:", "FILE, a telemetry log"),
)


def main() -> int:
    """Print the candidates for the words of the process, or of the line that bash gives; return 0.

    Prints nothing where file names are to be completed, and where anything fails: a message would stand in
    the middle of the line that the user types.
    """
    with suppress(Exception):
        shell = os.environ.get(COMPLETION_VARIABLE, "")
        words, cut = sys.argv, 0
        if shell == "bash":
            line, point = os.environ.get("COMP_LINE", ""), os.environ.get("COMP_POINT", "")
            words = split_line(line[: int(point)] if point else line)
            breaks = [each for each in os.environ.get("COMP_WORDBREAKS", "") if each in ":="]
            cut = max((words[-1].rfind(each) + 1 for each in breaks), default=0)
        found = list(candidates(words[1:], read_table()))
        sys.stdout.write("".join(f"{_line(shell, each, cut)}\n" for each in found))
        sys.stdout.flush()
    return 0


def split_line(line: str) -> list[str]:
    """Return the words of a line up to the cursor. The last one is that which is completed; it may be empty.

    Quotes and backslashes are removed; a quote may be open.
    """
    words, word, quote, is_word = [], "", "", False
    characters = iter(line)
    for each in characters:
        if quote and each == quote:
            quote = ""
        elif quote != "'" and each == "\\":
            word, is_word = word + next(characters, ""), True
        elif not quote and each in "'\"":
            quote, is_word = each, True
        elif not quote and each.isspace():
            if is_word:
                words.append(word)
            word, is_word = "", False
        else:
            word, is_word = word + each, True
    return [*words, word]


def candidates(words: Sequence[str], table: Table) -> Iterator[Candidate]:
    """Yield the candidates for the last of the words, which follow the name of the command."""
    *before, current = words or [""]
    groups = {name.partition(" ")[0] for name in table if " " in name}
    command = before[0] if before else ""
    if not before or (command in groups and len(before) == 1):
        yield from _fitting(_subcommands(table, command), current)
        return
    depth = 2 if command in groups else 1
    command = " ".join(before[:depth])
    options = table.get(command, {}).get("options", {})
    given, expected, cache, vehicle = _arguments(before[depth:], options)
    if vehicle is not None and POSITIONALS.get(command, ())[:1] == (VEHICLE,):
        given = [vehicle, *given]  # all arguments are names then
    if expected is not None:
        option = options[expected]
        kind = _OPTION_KINDS.get(expected, option["takes"])
        choices = [(each, "") for each in option["choices"]]
        yield from _fitting(choices or _of_kind(kind, given, command, cache, vehicle), current)
    elif current.startswith("-"):
        yield from _fitting(((name, option["help"]) for name, option in options.items()), current)
    else:
        place = len(given)
        if command == "set" and given:  # NAME VALUE and NAME=VALUE may be mixed
            place = 1
            for word in given[1:]:
                place = 1 if place == 2 or "=" in word else 2
        yield from _fitting(_of_kind(_kind(command, place), given, command, cache, vehicle), current)


def _fitting(found: Iterable[Candidate], current: str) -> Iterator[Candidate]:
    """Yield the candidates that begin with a word; in upper or lower case if none does exactly."""
    every = list(found)
    exact = [each for each in every if each[0].startswith(current)]
    yield from exact or [each for each in every if each[0].lower().startswith(current.lower())]


def _subcommands(table: Table, group: str) -> Iterator[Candidate]:
    """Yield the subcommands of a group; of the whole command for an empty name."""
    seen = set()
    for name, option in table.items():
        head, _, rest = name.partition(" ")
        word = (rest if head == group else "") if group else head
        if word and word not in seen:
            seen.add(word)
            yield word, "" if rest and not group else option["help"]


def _arguments(
    words: Sequence[str], options: dict[str, Any]
) -> tuple[list[str], str | None, str | None, str | None]:
    """Return the arguments without options, the option whose value is expected, the cache and the vehicle."""
    given, expected, cache, vehicle = [], None, None, None
    for word in words:
        if expected is not None:
            cache = word if expected == "--cache" else cache
            vehicle = word if expected == "--vehicle" else vehicle
            expected = None
        elif word.startswith("-"):
            expected = word if options.get(word, {}).get("takes") is not None else None
        else:
            given.append(word)
    return given, expected, cache, vehicle


def _kind(command: str, place: int) -> str:
    kinds = POSITIONALS.get(command, ())
    if not kinds:
        return TEXT
    return kinds[min(place, len(kinds) - 1)]


def _of_kind(
    kind: str, given: Sequence[str], command: str, cache: str | None, vehicle: str | None
) -> Iterator[Candidate]:
    if kind == LINK:
        yield from _LINKS
    elif kind in (VEHICLE, SOURCE):
        yield from _vehicles(cache)
    elif kind == "system":
        yield from dict(_systems(cache)).items()
    elif kind == NAME:
        owner = given[0] if given and POSITIONALS[command][0] == VEHICLE else vehicle
        yield from ((name, "") for name in _names(owner, cache))


def _vehicles(place: str | None) -> Iterator[Candidate]:
    """Yield the nicknames of the vehicles in the cache, then their keys."""
    with _OpenCache(place) as cache:
        if cache is None:
            return
        meanings = {each.key: str(each).partition("(")[2].rstrip(")") for each in cache.vehicles()}
        for nickname, key in cache.nicknames.items():
            if key in meanings:
                yield nickname, meanings[key]
        yield from meanings.items()


def _systems(place: str | None) -> Iterator[Candidate]:
    with _OpenCache(place) as cache:
        for vehicle in [] if cache is None else cache.vehicles():
            yield str(vehicle.identity.system), vehicle.key


def _names(owner: str | None, place: str | None) -> list[str]:
    """Return the cached names of a vehicle, by any of its names, or of the tables that changed last."""
    from paramclient.errors import UsageError

    with _OpenCache(place) as cache:
        if cache is None:
            return []
        tables = []
        with suppress(UsageError):  # no vehicle has this name, or several have it
            tables = cache.components(owner and owner.removeprefix("cache:"))
        tables = sorted(tables or cache.components(), key=lambda each: each.updated_at, reverse=True)
        names: set[str] = set()
        for each in tables[:TABLES_READ_MAX]:
            table = cache.load(each.key, each.component)
            names.update([] if table is None else table.params)
        return sorted(names)


class _OpenCache:
    """The cache as a context manager; None if there is no cache file. Databases are skipped as slow."""

    def __init__(self, place: str | None) -> None:
        self._place = place
        self._opened: Any = None

    def __enter__(self) -> Any:
        from paramclient.cache import ParamCache
        from paramclient.cache.database_url import is_address
        from paramclient.cache.store import default_path

        place = default_path() if self._place is None else self._place
        if not is_address(str(place)) and Path(place).is_file():
            self._opened = ParamCache(place)
        return self._opened

    def __exit__(self, *_: object) -> None:
        if self._opened is not None:
            self._opened.close()


def read_table() -> Table:
    """Return the table of the subcommands from its file, which is rewritten after a change of the command."""
    from platformdirs import user_cache_path

    path = user_cache_path("paramclient", appauthor=False) / "completion.json"
    version = _version()
    with suppress(OSError, ValueError, KeyError):
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["version"] == version:
            table: Table = kept["commands"]
            return table
    from paramclient.cli.completion_table import make_table

    table = make_table()
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_text(json.dumps({"version": version, "commands": table}), encoding="utf-8")
        part.replace(path)
    return table


def _version() -> str:
    """Return the version of the command, with the time of the latest change of its files."""
    from paramclient.version import __version__

    latest = max(each.stat().st_mtime_ns for each in os.scandir(Path(__file__).parent) if each.is_file())
    return f"{__version__} {latest}"


def _line(shell: str, candidate: Candidate, cut: int) -> str:
    word, meaning = candidate
    if shell == "bash":
        return word[cut:]
    meaning = " ".join(meaning.split())
    if shell == "zsh":
        word = word.replace(":", "\\:")
        return f"{word}:{meaning}" if meaning else word
    return f"{word}\t{meaning}"

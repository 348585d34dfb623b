"""Table of the subcommands for shell completion: their options, and the arguments of the options."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from cyclopts import App

from paramclient.cli.app import command_line

__all__ = ["make_table"]

_NEGATIVE = ("--no-", "--empty-")
"""Beginnings of the second names that cyclopts gives to options, and that the command line does not take."""


def make_table() -> dict[str, dict[str, Any]]:
    """Return the subcommands by name, as `completion.Table` describes. Imports all subcommands."""
    return dict(_entries(command_line(), ""))


def _entries(app: App, group: str) -> list[tuple[str, dict[str, Any]]]:
    found = []
    for name in app:
        if name.startswith("-"):
            continue
        command = app[name]
        words = f"{group} {name}".lstrip()
        if any(not each.startswith("-") for each in command):
            found += _entries(command, words)
        else:
            found.append((words, {"help": _sentence(command.help), "options": _options(command)}))
    return found


def _options(command: App) -> dict[str, dict[str, Any]]:
    options = {}
    for each in command.assemble_argument_collection(parse_docstring=True):
        if not each.show or not each.names or not each.names[0].startswith("-"):
            continue
        takes: str | None = None
        if each.token_count()[0]:
            takes = "file" if Path in (each.hint, *get_args(each.hint)) else "text"
        described = {
            "help": _sentence(each.parameter.help),
            "takes": takes,
            "choices": list(each.get_choices() or ()),
        }
        names = [name for name in each.names if name == each.names[0] or not name.startswith(_NEGATIVE)]
        options.update(dict.fromkeys(names, described))
    return options


def _sentence(text: str | None) -> str:
    """Return the first sentence of a description."""
    return " ".join((text or "").split("\n\n")[0].split()).partition(". ")[0].rstrip(".")

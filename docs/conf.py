"""Sphinx configuration of the pages; `make docs` builds them."""

from __future__ import annotations

from typing import Any

from paramclient import __version__

project = "paramclient"
author = "The paramclient authors"
project_copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
default_role = "py:obj"
suppress_warnings = ["ref.python"]  # a word in backticks may be a member of several classes
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
autodoc_default_options = {"members": True, "undoc-members": True}
napoleon_numpy_docstring = False
# one field may document several names, as in "system, component: own ids", which only this form supports
napoleon_use_param = False
napoleon_custom_sections = [("Attributes", "params_style"), ("Args of every vehicle", "params_style")]

html_theme = "furo"
html_title = f"paramclient {version}"
html_copy_source = False
html_show_sphinx = False


STAND_IN = "\ue000"
"""Replaces a colon, which napoleon reads as the end of a type in an attribute's first line."""


def setup(app: Any) -> None:
    """Called by Sphinx. napoleon has priority 500."""
    app.connect("autodoc-process-docstring", hide_colons, priority=400)
    app.connect("autodoc-process-docstring", show_colons, priority=600)
    app.connect("autodoc-skip-member", skip_repeated)


def hide_colons(app: Any, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Let a docstring such as "The autopilot: px4, ardupilot, …" remain a sentence."""
    if what in ("attribute", "data", "property") and lines:
        lines[0] = lines[0].replace(": ", f"{STAND_IN} ")


def show_colons(app: Any, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Undo `hide_colons`."""
    lines[:] = [line.replace(STAND_IN, ":") for line in lines]


SEEN: set[int] = set()
"""The objects on the page of the API: those of `paramclient` come first."""


def skip_repeated(app: Any, what: str, name: str, thing: object, skip: bool, options: object) -> bool | None:
    """Document what several modules export in the first of them."""
    if what != "module" or not hasattr(thing, "__qualname__"):
        return None
    is_repeated = id(thing) in SEEN
    SEEN.add(id(thing))
    return is_repeated or None

"""The subcommand show: cached tables, parameter files and logs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Final

from paramclient.cache import ParamCache
from paramclient.cli.cached import extended_sizes, show_summaries
from paramclient.cli.file_output import described, value_text
from paramclient.cli.json_output import JsonObject, info_json, known_members, set_json
from paramclient.cli.metadata import (
    MetadataChoice,
    defaults_in,
    from_file,
    info_of,
    meaning_of,
    print_descriptions,
    report_no_defaults,
    say_sources,
    units_of,
)
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import ExitCode, print_json, print_table, say
from paramclient.cli.param_names import check_given
from paramclient.cli.sources import check_link
from paramclient.files.formats import address
from paramclient.metadata import Metadata, MetadataStore
from paramclient.model.comparison import non_defaults
from paramclient.model.names import NameChoice
from paramclient.model.paramset import Default, ParamSet, add_default, default_of
from paramclient.provision.sources import link_of, read_source, resolve

_DEFAULTS: Final = CacheOptions()


async def show(
    vehicle: str | None = None,
    /,
    *names: str,
    changed: bool = False,
    metadata: MetadataChoice = None,
    extended: bool = False,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
    """Print the cached parameters of a vehicle, or those of a parameter file or a log.

    With --changed, exit code 1: the firmware's defaults are not known.

    Args:
        vehicle: A parameter file, or - for the standard input; a log (.bin, .ulg, .tlog); a vehicle in the
            cache: 4 or 4/1, px4 or ardupilot, its hardware id (in full, or uid: and at least 6 digits) or its
            key, also with the prefix cache:. Default: the list of vehicles, or the only one.
        changed: Print only parameters that differ from the firmware's defaults: those of the vehicle, else
            those of its metadata.
        names: Print only these parameters, with their metadata: names in upper or lower case, or patterns
            such as "MC_*".
        metadata: A file that describes parameters. Default: the stored metadata of the vehicle's firmware.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    chosen, given = check_given(names), from_file(metadata, offline=True)
    with ParamCache(options.cache) as cache:
        if vehicle is None:
            summaries = cache.components(extended=extended)
            if len(summaries) != 1:
                show_summaries(cache, summaries, extended_sizes(cache), json=options.json)
                return ExitCode.DONE
            vehicle = f"cache:{summaries[0].key}"
        check_link(link_of(vehicle))
        found = read_source(vehicle, every=True, extended=extended, incomplete=True, cache=cache)
        sets = [await resolve(vehicle, cache=False)] if found is None else found.sets
        everything = {name for each in sets for name in each}
        kept = NameChoice(chosen).choose(everything) if chosen else everything
        known = MetadataStore.beside(cache.path).known_of_sets(sets) if given is None else [given] * len(sets)
    views = [
        _View(_part(each, kept), metadata, is_chosen=bool(chosen), is_changed=changed)
        for each, metadata in zip(sets, known, strict=True)
    ]
    if options.json:
        print_json({"components": [view.as_json() for view in views]})
    elif not changed or any(view.defaults for view in views):
        for view in views:
            view.print()
    if changed and not any(view.defaults for view in views):
        report_no_defaults()
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


def _part(params: ParamSet, names: Collection[str]) -> ParamSet:
    return replace(params, params={name: param for name, param in params.items() if name in names})


class _View:
    """The parameters of a set that are shown.

    Args:
        params: the set.
        metadata: its metadata, or None.
        is_chosen: whether the user has named the parameters.
        is_changed: whether only parameters that differ from the defaults are shown.
    """

    def __init__(
        self, params: ParamSet, metadata: Metadata | None, *, is_chosen: bool, is_changed: bool
    ) -> None:
        self._metadata, self._is_chosen, self._is_changed = metadata, is_chosen, is_changed
        more = defaults_in(metadata, params)
        found = {name: default_of(param, more.get(name)) for name, param in params.items()}
        self.defaults = {name: default for name, default in found.items() if default is not None}
        filled = {name: add_default(param, more.get(name)) for name, param in params.items()}
        self._shown = replace(params, params=filled)
        if is_changed:
            self._shown = non_defaults(self._shown)

    def as_json(self) -> JsonObject:
        """Return the JSON of the set; of chosen parameters with their metadata."""
        sources = {name: default.source for name, default in self.defaults.items()}
        shown = set_json(self._shown, sources)
        for name, param in shown["params"].items():
            if (info := info_of(self._metadata, name)) is not None:
                text, units = info.text(self._shown[name].settable), info.units
                param |= known_members(text=text or None, units=units or None)
                param |= {"metadata": info_json(info)} if self._is_chosen else {}
        return shown

    def print(self) -> None:
        """Print the table without empty columns, and a line about it on stderr."""
        columns = ("name", "value", "default", "type", "meaning", "units", "comment")
        rows = [
            (
                param.name,
                value_text(param),
                None if param.default is None else value_text(replace(param, value=param.default)),
                None if param.type is None else param.type.name,
                meaning_of(self._metadata, param.name, param.settable),
                units_of(self._metadata, param.name),
                param.comment or None,
            )
            for param in self._shown.values()
        ]
        print_table(columns, rows, right="value default")
        if self._is_chosen and self._metadata is not None:
            print_descriptions(self._shown, self._metadata)
        say(described(self._shown) + (", those that differ from their default" if self._is_changed else ""))
        if self._is_changed:
            shown: list[Default] = [self.defaults[name] for name in self._shown]
            say_sources(address(self._shown), shown)

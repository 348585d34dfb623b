"""The subcommands show, search and info, which need no link: cached tables, files, logs and descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from paramclient.cache import CachedComponent, ParamCache
from paramclient.cli import output
from paramclient.cli.cached import show_summaries
from paramclient.cli.json_output import info_json, info_of, param_value, set_json, table_param_json, taken
from paramclient.cli.metadata import METADATA_HINT, MetadataFile, default_in, known_of_sets, say_sources
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import ExitCode, cells_of, local_time, print_line, report, say
from paramclient.cli.session import check_given
from paramclient.cli.sources import check_link, described, part_of
from paramclient.errors import UsageError, VehicleError
from paramclient.files.formats import address
from paramclient.metadata import Metadata, MetadataStore, ParamInfo
from paramclient.model.comparison import non_defaults
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import time_text
from paramclient.model.paramset import add_defaults
from paramclient.model.values import check_name
from paramclient.provision.sources import NO_DEFAULTS, choose_names, link_of, read_source, resolve, tables_in


async def show(
    vehicle: str | None = None,
    /,
    *names: str,
    changed: bool = False,
    metadata: MetadataFile = None,
    extended: bool = False,
    options: CacheOptions = CacheOptions(),
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
    chosen = check_given(names)
    with ParamCache(options.cache) as cache:
        if vehicle is None:
            summaries = cache.components(extended=extended)
            if len(summaries) != 1:
                show_summaries(cache, summaries, json=options.json)
                return ExitCode.DONE
            vehicle = f"cache:{summaries[0].key}"
        check_link(link_of(vehicle))
        found = read_source(vehicle, every=True, extended=extended, incomplete=True, cache=cache)
        sets = [await resolve(vehicle, cache=False, incomplete=True)] if found is None else found.sets
    kept = choose_names(chosen, sets)
    views = []
    for whole, known in zip(sets, known_of_sets(sets, options, metadata), strict=True):
        part = part_of(whole, kept)
        defaults = {name: default for name, each in part.items() if (default := default_in(known, each))}
        given = {name: default.value for name, default in defaults.items()}
        shown = part_of(part, non_defaults(add_defaults(part, given))) if changed else part
        views.append((shown, known, defaults))
    if changed and not any(defaults for _, _, defaults in views):
        raise VehicleError(NO_DEFAULTS, sets[0].system or 0, sets[0].component or 0)
    items = [set_json(shown, known, whole=bool(chosen)) for shown, known, _ in views]
    if options.json:
        output.print_json({"components": items})
        return ExitCode.DONE
    for (shown, known, defaults), item in zip(views, items, strict=True):
        columns = ("name", "value", "default", "type", "meaning", "units", "comment")
        vehicle = address(shown) if len(items) > 1 else None
        rows = ([vehicle, *cells] for cells in cells_of(item["params"], *columns[1:]))
        output.print_table(["vehicle", *columns], rows)
        for name in shown if chosen and known is not None else ():
            _print_description(name, info_of(known, name))
        say(described(shown) + (", those that differ from their default" if changed else ""))
        if changed:
            say_sources(address(shown), [defaults[name] for name in shown])
    return ExitCode.DONE


def search(
    word: str,
    /,
    *words: str,
    vehicle: str | None = None,
    metadata: MetadataFile = None,
    options: CacheOptions = CacheOptions(),
) -> ExitCode:
    """Find parameters whose name, description or value names contain all words, in upper or lower case.

    Searches the tables in the cache, with the stored metadata of their firmware, and the file of --metadata.
    Parameters with the words in their name come first, then those with the words in the short description.
    Exit code 1: nothing was found.

    Args:
        word: A word or a part of one, or several words in quotes.
        words: Further words.
        vehicle: Search only this vehicle in the cache: 4, px4 or ardupilot, its hardware id, or its key.
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    lowered_words = " ".join((word, *words)).casefold().split()
    if not lowered_words:
        raise UsageError("search takes one or more words")
    known = _Cached(options, vehicle, metadata)
    ranks = {name: _rank(name, known.info(name), lowered_words) for name in known.names}
    found, rows = [], []
    for _, name in sorted((rank, name) for name, rank in ranks.items() if rank is not None):
        tables, info = known.having(name), known.info(name)
        description = (info and info.short_description) or None
        found.append({"name": name, "description": description, "vehicles": [each.key for each in tables]})
        values = {param_value(each.params[name]) for each in tables}
        value = f"{len(values)} values" if len(values) > 1 else next(iter(values), None)
        where = ", ".join(f"{each.system}/{each.component}" for each in tables)
        rows.append((name, value, where, description))
    output.show({"results": found}, ["name", "value", "vehicle", "description"], rows, json=options.json)
    if not found:
        report(f"nothing found; {counted(len(known.names), 'parameter')} searched")
    if known.undescribed and not options.json:
        say(f"only names of {known.undescribed} were searched: {METADATA_HINT}")
    return ExitCode.DONE if found else ExitCode.INCOMPLETE


def info(
    name: str,
    /,
    *,
    vehicle: str | None = None,
    metadata: MetadataFile = None,
    options: CacheOptions = CacheOptions(),
) -> ExitCode:
    """Print the description, range, value names and cached values of a parameter.

    Args:
        name: The parameter, in upper or lower case.
        vehicle: Only of this vehicle in the cache: 4, px4 or ardupilot, its hardware id, or its key.
        metadata: A file that describes parameters. Default: the stored metadata of each vehicle's firmware.
    """
    known = _Cached(options, vehicle, metadata)
    spelled = next((each for each in known.names if each.upper() == name.upper()), check_name(name).upper())
    info = known.info(spelled)  # also that of a group, FOO{n}_BAR, which is not among the names
    if info is None:
        NameChoice([name]).choose(known.names, " of the cache")
    vehicles, rows = [], []
    for table in known.having(spelled):
        param, heard = table_param_json(table.params[spelled], info), table.heard_at[spelled]
        autopilot, where = autopilot_name(table.autopilot), taken(table, "key", "system", "component")
        vehicles.append(where | {"autopilot": autopilot, "heard_at": time_text(heard), "param": param})
        cells = map(param.get, ("value", "text", "type", "default", "default_source"))
        rows.append((f"{table.system}/{table.component}", *cells, local_time(heard), table.key))
    if options.json:
        output.print_json({"name": spelled, "metadata": info and info_json(info), "vehicles": vehicles})
        return ExitCode.DONE
    _print_description(spelled, info)
    if info is None and known.undescribed:
        say(f"no metadata of {known.undescribed} is known: {METADATA_HINT}")
    if rows:
        print_line("")
        output.print_table(("vehicle", "value", "meaning", "type", "default", "source", "heard", "key"), rows)
    return ExitCode.DONE


class _Cached:
    """The cached tables of all vehicles or of one, and their metadata.

    Attributes:
        names: the names of the tables; without a table, those of the metadata.
        undescribed: the vehicles without metadata, in words. A camera has none: its firmware has none.
    """

    def __init__(self, options: CacheOptions, vehicle: str | None, given: Metadata | None) -> None:
        with ParamCache(options.cache) as cache:
            summaries = cache.components() if vehicle is None else tables_in(cache, vehicle)
            summaries = sorted(summaries, key=lambda each: (each.system, each.component))
            self._tables = tables = cache.load_all(summaries)
            store = MetadataStore.beside(cache.path)
        found = [given or store.known(table.identity, table.component) for table in tables]
        self._metadata = [*{id(each): each for each in (given, *found) if each is not None}.values()]
        self.names = {name for table in tables for name in table.params}
        if given is not None:
            self.names.update(name for name in given if "{" not in name)
        self.undescribed = ", ".join(
            f"{table.system}/{table.component} {autopilot_name(table.autopilot)}"
            for table, each in zip(tables, found, strict=True)
            if each is None and has_autopilot(table.autopilot)
        )

    def info(self, name: str) -> ParamInfo | None:
        """Return the description of a parameter, or None."""
        return next((known for each in self._metadata if (known := each.find(name)) is not None), None)

    def having(self, name: str) -> list[CachedComponent]:
        """Return the tables with this parameter."""
        return [table for table in self._tables if name in table.params]


def _rank(name: str, info: ParamInfo | None, lowered_words: Sequence[str]) -> int | None:
    """Return 0 if all words are in the name, 1 with the short description, 2 elsewhere; None if not."""
    text, more = name, [""]
    if info is not None:
        named = [*info.values.values(), *info.bits.values(), info.group]
        more += [info.short_description, " ".join([info.long_description, *named])]
    for rank, each in enumerate(more):
        text = f"{text} {each}".casefold()
        if all(word in text for word in lowered_words):
            return rank
    return None


def _print_description(name: str, info: ParamInfo | None) -> None:
    """Print the whole metadata of a parameter as text."""
    lines = [f"\n{name} is not described."]
    if info is not None:
        texts = (f"  {line}" if line.strip() else "" for line in info.long_description.splitlines())
        lines = [f"\n{name}: {info.short_description}".removesuffix(": "), *texts]
        lines += [f"  {fact}" for fact in _facts(info)]
    print_line("\n".join(lines))


def _facts(info: ParamInfo) -> Iterator[str]:
    found, units = info_json(info), f" {info.units}" if info.units else ""
    if not found.keys().isdisjoint(("minimum", "maximum")):
        yield f"range: {found.get('minimum', '...')} to {found.get('maximum', '...')}{units}"
    elif units:
        yield f"units:{units}"
    yield from (f"{each}: {found[each]}{units}" for each in ("increment", "default") if each in found)
    yield from (f"{value}: {name}" for value, name in found.get("values", {}).items())
    yield from (f"bit {bit}: {name}" for bit, name in found.get("bits", {}).items())
    if info.is_read_only:
        yield "read-only: the vehicle sets it"
    if info.reboot_required:
        yield "reboot: a change takes effect after a reboot"

"""The subcommands show, search and info, which need no link: cached tables, files, logs and descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from paramclient.cache import CachedComponent, ParamCache
from paramclient.cli import output
from paramclient.cli.cached import show_summaries
from paramclient.cli.json_output import info_json, info_of, param_value, set_json, table_param_json, taken
from paramclient.cli.metadata import METADATA_HINT, MetadataFile, default_in, known_of_sets, say_sources
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import ExitCode, cells_of, local_time, print_line, report, say
from paramclient.cli.session import check_given
from paramclient.cli.sources import described, part_of, sets_of
from paramclient.errors import UsageError, VehicleError
from paramclient.files.formats import address
from paramclient.metadata import Metadata, MetadataStore, ParamInfo
from paramclient.model.comparison import non_defaults
from paramclient.model.identity import autopilot_name, has_autopilot
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import time_text
from paramclient.model.paramset import add_defaults
from paramclient.model.values import check_name
from paramclient.provision.sources import NO_DEFAULTS, choose_names, read_source, tables_in


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
        found = read_source(vehicle, every=True, extended=extended, incomplete=True, cache=cache)
        link = LinkOptions(cache=options.cache, extended=extended)
        sets = found.sets if found is not None else (await sets_of(vehicle, link, incomplete=True))[0]
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
        vehicle = address(shown) if len(items) > 1 or found is None else None
        rows = ([vehicle, *cells] for cells in cells_of(item["params"], *columns[1:]))
        output.print_table(["vehicle", *columns], rows)
        for name in shown if chosen and known is not None else ():
            _print_description(name, info_of(known, name))
        how = ", those that differ from their default" if defaults else "; the defaults are not known"
        say(described(shown) + (how if changed else ""))
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
    ranks = [_rank(name, known.infos(name), lowered_words) for name in known.names]
    found, rows = [], []
    for _, name, description in sorted(filter(None, ranks)):
        tables = [table for table, _ in known.having(name)]
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
    infos = known.infos(spelled)  # also that of a group, FOO{n}_BAR, which is not among the names
    if not infos:
        NameChoice([name]).choose(known.names, " of the cache")
    vehicles, rows = [], []
    for table, info in known.having(spelled):
        param, heard = table_param_json(table.params[spelled], info), table.heard_at[spelled]
        autopilot, where = autopilot_name(table.autopilot), taken(table, "key", "system", "component")
        vehicles.append(where | {"autopilot": autopilot, "heard_at": time_text(heard), "param": param})
        cells = map(param.get, ("value", "text", "type", "default", "default_source"))
        rows.append((f"{table.system}/{table.component}", *cells, local_time(heard), table.key))
    if options.json:
        one = info_json(infos[0]) if len(infos) == 1 else None  # vehicles may have different ones
        output.print_json({"name": spelled, "metadata": one, "vehicles": vehicles})
        return ExitCode.DONE
    for info in (*infos,) or (None,):
        of = [f"{each.system}/{each.component}" for each, own in known.having(spelled) if own == info]
        _print_description(f"{spelled} of {', '.join(of)}" if len(infos) > 1 else spelled, info)
    if not infos and known.undescribed:
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
            tables = sorted(cache.load_all(summaries), key=lambda each: (each.system, each.component))
            store = MetadataStore.beside(cache.path)
        found = [given or store.known(table.identity, table.component) for table in tables]
        self._tables, self._metadata = [*zip(tables, found, strict=True)], (given, *found)
        self.names = {name for table in tables for name in table.params}
        self.names |= {name for name in given or () if "{" not in name}
        without = [table for table, each in self._tables if each is None and has_autopilot(table.autopilot)]
        names = (f"{each.system}/{each.component} {autopilot_name(each.autopilot)}" for each in without)
        self.undescribed = ", ".join(names)

    def infos(self, name: str) -> list[ParamInfo]:
        """Return the different descriptions of a parameter: those of the tables with it, if there are any."""
        own = [info for _, info in self.having(name)] or [info_of(each, name) for each in self._metadata]
        known = [info for info in own if info is not None]
        return [info for at, info in enumerate(known) if info not in known[:at]]

    def having(self, name: str) -> list[tuple[CachedComponent, ParamInfo | None]]:
        """Return the tables with this parameter, each with the description of its own firmware."""
        return [(table, info_of(each, name)) for table, each in self._tables if name in table.params]


def _rank(name: str, infos: Sequence[ParamInfo], words: Sequence[str]) -> tuple[int, str, str | None] | None:
    """Return the rank of a name, the name, and the description that has it; None without all words.

    The rank is 0 if all words are in the name, 1 with the short description, 2 elsewhere.
    """
    texts = []
    for info in infos:
        named = [info.long_description, *info.values.values(), *info.bits.values(), info.group]
        texts.append((name, info.short_description, " ".join(named)))
    for rank in range(3):
        for text in (*texts, (name, "")):
            if all(word in " ".join(text[: rank + 1]).casefold() for word in words):
                return rank, name, text[1] or None
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

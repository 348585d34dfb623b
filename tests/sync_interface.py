"""The blocking classes, written from the asynchronous interface: `python -m tests.sync_interface`.

The program reads signatures and docstrings of the interface, and writes `paramclient/sync/blocking.py`. A
test compares the file with what the program would write, so that the two interfaces cannot differ. The result
is laid out as `ruff format` does it.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["BLOCKING", "blocking_source"]

ROOT = Path(__file__).parent.parent
CLIENT = ROOT / "paramclient/client"
BLOCKING = ROOT / "paramclient/sync/blocking.py"
WIDTH = 110

WRAPPED = {
    "ParamClient": "client",
    "Component": "component",
    "ExtParams": "extended_params",
    "Ftp": "files",
}
"""The classes of the interface, and their modules in `paramclient.client`."""

STREAMS = {"Events": "events", "Changes": "subscription", "ExtChanges": "extended_params"}
"""The streams, and their modules."""

BY_HAND = {"__init__", "__repr__", "__aenter__", "__aexit__", "open", "aclose"}
"""Methods of `ParamClient` that are not generated: `BlockingClient` has them, `aclose` as `close`."""

SET_IN_INIT = {"ParamClient": {"cache": "ParamCache | None"}}
"""Public attributes without an annotation in the body of their class."""

WORDS = {
    r", as an async context manager\.": ", with calls that block.",
    r"Inside the `async with`, the client sends": (
        "The client runs in a thread of its own. Inside the `with`, it sends"
    ),
    r"in other tasks": "in other threads",
    r"no task, socket or thread remains": "no socket or thread remains",
    r"also if the body is cancelled": "also after Ctrl-C",
    r"Where an `async with` does not fit, such as in `python -m asyncio`, call `open` and `aclose`\.": (
        "Where a `with` does not fit, such as in a REPL, call `open` and `close`. A client that is not closed"
        " is closed when the last reference to it is dropped, and at the end of the program."
    ),
    r"`async for (\w+ in \w+\.\w+\(\))`": r"`for \1`",
    r"All calls may be cancelled at any point; later calls are not affected\.": (
        "Ctrl-C ends a waiting call; later calls are not affected. Several threads may call at the same time."
    ),
    r"from this task": "in the calling thread",
    r"Cancelling the iteration": "Ctrl-C",
    r"\b[Cc]ancellation\b": "Ctrl-C",
}
"""What docstrings say of tasks, and what it is for threads."""

ASYNCHRONOUS_WORDS = re.compile(r"async|await|cancel|\btasks?\b|event loop|aclose", re.IGNORECASE)
"""Words without a meaning for users of the blocking client."""

HEAD = '''"""The blocking classes, generated from the asynchronous ones: see `make sync`."""

from __future__ import annotations

'''


@dataclass
class Source:
    """A module of the interface.

    Attributes:
        tree: its syntax tree.
        imports: modules from which it imports names.
        modules: modules that it imports whole.
        for_types: names that it imports for type checkers only.
    """

    tree: ast.Module
    imports: dict[str, str] = field(default_factory=dict)
    modules: set[str] = field(default_factory=set)
    for_types: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, module: str) -> Source:
        """Read a module of `paramclient.client`."""
        source = cls(ast.parse((CLIENT / f"{module}.py").read_text(encoding="utf-8")))
        for node in ast.walk(source.tree):
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                source.imports |= {alias.name: node.module for alias in node.names}
            if isinstance(node, ast.Import):
                source.modules |= {alias.name for alias in node.names}
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                imports = (each for each in node.body if isinstance(each, ast.ImportFrom))
                source.for_types |= {alias.name for each in imports for alias in each.names}
        return source

    def class_of(self, name: str) -> ast.ClassDef:
        """Return a class of the module."""
        (found,) = (node for node in self.tree.body if isinstance(node, ast.ClassDef) and node.name == name)
        return found


class Writer:
    """Writes the module of the blocking classes."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.sources = {
            module: Source.of(module) for module in sorted({*WRAPPED.values(), *STREAMS.values()})
        }
        self.events = [
            node
            for node in self.sources["events"].tree.body
            if isinstance(node, ast.ClassDef) and node.decorator_list
        ]
        self.own = {*WRAPPED, *STREAMS, "Event", *(node.name for node in self.events)}
        self.imports: dict[str, set[str]] = {
            "dataclasses": {"dataclass", "fields"},
            "functools": {"cached_property", "partial"},
            "typing": {"Any", "TYPE_CHECKING", "TypeAlias"},
            "collections.abc": {"Mapping"},
            "paramclient.client": {"events as asynchronous"},
            "paramclient.sync.client_thread": {"ClientThread"},
            "paramclient.sync.wrappers": set(),
        }
        for name, module in WRAPPED.items():
            self.imports[f"paramclient.client.{module}"] = {f"{name} as Async{name}"}
        self.modules: set[str] = set()
        self.for_types: dict[str, set[str]] = {}
        self.used_words: set[str] = set()

    def source(self) -> str:
        """Return the whole module."""
        for name, module in WRAPPED.items():
            self.write_class(name, self.sources[module])
        for node in self.events:
            self.write_event(node)
        self.write_event_types()
        for name, module in STREAMS.items():
            self.write_stream(name, self.sources[module])
        self.lines += REST.splitlines()
        assert self.used_words == WORDS.keys(), f"no docstring has {WORDS.keys() - self.used_words}"
        body = "\n".join(self.lines)
        helpers = ("BlockingClient", "BlockingStream", "LiveMapping", "Wrapper", "live_mapping")
        self.imports["paramclient.sync.wrappers"] |= {
            name for name in (*helpers, "live_params", "own_values", "wrapped_by") if name in body
        }
        return HEAD + "\n".join([*self.import_lines(), "", *self.offers(), body]) + "\n"

    def write(self, line: str, level: int) -> None:
        self.lines.append("    " * level + line if line else "")

    # imports

    def import_lines(self) -> Iterator[str]:
        own = sorted(module for module in self.imports if module.startswith("paramclient"))
        yield from (f"import {module}" for module in sorted(self.modules))
        yield from self.import_block([module for module in sorted(self.imports) if module not in own])
        yield ""
        yield from self.import_block(own)
        yield ""
        yield "if TYPE_CHECKING:"
        for module, names in sorted(self.for_types.items()):
            yield f"    from {module} import {', '.join(sorted(names))}"

    def import_block(self, modules: list[str]) -> Iterator[str]:
        for module in modules:
            names = sorted(self.imports[module], key=import_order)
            renamed = [name for name in names if " as " in name]
            for name in renamed:
                yield f"from {module} import {name}"
            plain = [name for name in names if name not in renamed]
            line = f"from {module} import {', '.join(plain)}"
            if plain and len(line) <= WIDTH:
                yield line
            elif plain:
                yield f"from {module} import ("
                yield from (f"    {name}," for name in plain)
                yield ")"

    def offers(self) -> Iterator[str]:
        yield "__all__ = ["
        yield from (f'    "{name}",' for name in sorted(self.own))
        yield "]"

    def use(self, node: ast.AST | None, source: Source) -> None:
        """Import the names of an annotation or a default."""
        for each in ast.walk(node) if node is not None else ():
            if isinstance(each, ast.Name) and each.id not in self.own:
                module = source.imports.get(each.id)
                if each.id in source.for_types:
                    assert module is not None
                    self.for_types.setdefault(module, set()).add(each.id)
                elif module is not None:
                    self.imports.setdefault(module, set()).add(each.id)
                elif each.id in source.modules:
                    self.modules.add(each.id)

    # classes

    def write_class(self, name: str, source: Source) -> None:
        node = source.class_of(name)
        base = "BlockingClient" if name == "ParamClient" else f"Wrapper[Async{name}]"
        doc = self.docstring(node)
        self.begin_class(f"class {name}({base}):", doc)
        for each in node.body:
            if isinstance(each, ast.FunctionDef) and each.name == "__init__" and name == "ParamClient":
                self.write_init(each, source)
        attributes = {
            each.target.id: ast.unparse(each.annotation)
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        }
        for attribute, kind in (attributes | SET_IN_INIT.get(name, {})).items():
            if not attribute.startswith("_"):
                self.use(ast.parse(kind), source)
                self.write_attribute(attribute, kind, doc)
        for each in node.body:
            if not isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if each.name in BY_HAND or each.name.startswith("_"):
                continue
            if any(ast.unparse(decorator) == "property" for decorator in each.decorator_list):
                self.write_property(each, source)
            else:
                self.write_method(each, source)

    def begin_class(self, line: str, doc: list[str]) -> None:
        self.lines += ["", ""]
        self.write(line, 0)
        self.write_docstring(doc, 1)

    def write_init(self, node: ast.FunctionDef, source: Source) -> None:
        self.lines.append("")
        self.write_signature("__init__", node, source)
        made = Call("partial", ["AsyncParamClient", *arguments_of(node)])
        self.lines += Call("super().__init__", [made]).laid_out(8, "", "")

    def write_attribute(self, name: str, kind: str, doc: list[str]) -> None:
        texts = [text for names, text in attributes_in(doc) if name in names]
        assert texts, f"the docstring of the class says nothing of {name}"
        is_live = kind.startswith(("ParamMap", "Mapping"))
        self.lines.append("")
        self.write("@cached_property" if is_live else "@property", 1)
        self.write(f"def {name}(self) -> {kind}:", 1)
        self.write_docstring(filled(texts[0][0].upper() + texts[0][1:], "", "", 2), 2)
        if kind == "ParamMap":
            self.write(f"return live_params(self._thread, self._wrapped.{name})", 2)
        elif is_live:
            self.write(f"return live_mapping(self._thread, self._wrapped.{name})", 2)
        else:
            self.write(f"return self._wrapped.{name}", 2)

    def write_property(self, node: ast.FunctionDef | ast.AsyncFunctionDef, source: Source) -> None:
        kind = ast.unparse(node.returns) if node.returns is not None else ""
        self.use(node.returns, source)
        self.lines.append("")
        self.write("@property", 1)
        self.write(f"def {node.name}(self) -> {kind}:", 1)
        self.write_docstring(self.docstring(node), 2)
        self.write_return(kind, f"self._thread.read(lambda: self._wrapped.{node.name})")

    def write_method(self, node: ast.FunctionDef | ast.AsyncFunctionDef, source: Source) -> None:
        kind = ast.unparse(node.returns) if node.returns is not None else ""
        self.lines.append("")
        self.write_signature(node.name, node, source)
        self.write_docstring(self.docstring(node), 2)
        given = arguments_of(node)
        called: str | Call = f"self._wrapped.{node.name}"
        if kind in STREAMS:
            self.write(f"return {kind}(self._thread, {called})", 2)
            return
        if "progress=progress" in given:
            given.remove("progress=progress")
            how, more = "call_reporting", ["progress"]
        else:
            how, more = "call" if isinstance(node, ast.AsyncFunctionDef) else "read", []
        if given:
            called = Call("partial", [called, *given])
        call = Call(f"self._thread.{how}", [called, *more])
        if kind in WRAPPED:
            call = Call(f"{kind}.of", ["self._thread", call])
        if kind == "list[Component]":
            self.lines += call.laid_out(8, "found = ", "")
            self.write("return [Component.of(self._thread, each) for each in found]", 2)
            return
        assert kind in self.own or not self.own & names_in(node.returns), f"{node.name} -> {kind}"
        self.lines += call.laid_out(8, "" if kind == "None" else "return ", "")

    def write_return(self, kind: str, value: str) -> None:
        if kind in WRAPPED:
            value = f"{kind}.of(self._thread, {value})"
        elif kind == "list[Component]":
            self.write(f"found = {value}", 2)
            value = "[Component.of(self._thread, each) for each in found]"
        elif kind == "Mapping[Address, Component]":
            value = "_components(self._thread, self._wrapped)"
        else:
            assert not self.own & names_in(ast.parse(kind)), kind
        self.write(f"return {value}", 2)

    def write_signature(
        self, name: str, node: ast.FunctionDef | ast.AsyncFunctionDef, source: Source
    ) -> None:
        for each in ast.walk(node.args):
            if isinstance(each, ast.arg):
                self.use(each.annotation, source)
        for default in [*node.args.defaults, *node.args.kw_defaults]:
            self.use(default, source)
        self.use(node.returns, source)
        returns = "" if node.returns is None else f" -> {quoted(node.returns)}"
        self.lines += Call(f"def {name}", list(parameters_of(node.args))).laid_out(4, "", f"{returns}:")

    def write_stream(self, name: str, source: Source) -> None:
        node = source.class_of(name)
        (base,) = node.bases
        assert isinstance(base, ast.Subscript)
        item = ast.unparse(base.slice)
        self.use(base.slice, source)
        self.begin_class(f"class {name}(BlockingStream[{item}]):", self.docstring(node))
        if name == "Events":
            self.lines.append("")
            self.write("def _made(self, item: asynchronous.Event) -> Event:", 1)
            self.write("return _event(self._thread, item)", 2)

    def write_event(self, node: ast.ClassDef) -> None:
        self.lines += ["", ""]
        self.lines += [f"@{ast.unparse(each)}" for each in node.decorator_list]
        self.lines.append(f"class {node.name}:")
        self.write_docstring(self.docstring(node), 1)
        self.lines.append("")
        for each in node.body:
            if isinstance(each, ast.AnnAssign):
                self.use(each.annotation, self.sources["events"])
                self.write(ast.unparse(each), 1)

    def write_event_types(self) -> None:
        names = [node.name for node in self.events]
        self.lines += ["", "", f"Event: TypeAlias = {' | '.join(names)}", ""]
        self.lines += ["_EVENTS: dict[type[asynchronous.Event], type[Event]] = {"]
        self.lines += [f"    asynchronous.{name}: {name}," for name in names]
        self.lines.append("}")

    # docstrings

    def docstring(self, node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
        """Return the docstring of a class or function, in the words of the blocking client."""
        text = ast.get_docstring(node)
        assert text, f"{node.name} has no docstring"
        level = 1 if isinstance(node, ast.ClassDef) else 2
        lines: list[str] = []
        for first, hanging, item in items_of(text):
            changed = " ".join(item)
            for words, others in WORDS.items():
                changed, count = re.subn(words, others, changed)
                if count:
                    self.used_words.add(words)
            found = ASYNCHRONOUS_WORDS.search(changed)
            assert not found, f"{node.name}: {found and found[0]} in {changed!r}"
            if changed == " ".join(item):
                lines += [first + item[0], *(hanging + line for line in item[1:])]
            else:
                lines += filled(changed, first, hanging, level)
        return lines

    def write_docstring(self, lines: list[str], level: int) -> None:
        if len(lines) == 1:
            self.write(f'"""{lines[0]}"""', level)
            return
        self.write(f'"""{lines[0]}', level)
        for line in lines[1:]:
            self.write(line, level)
        self.write('"""', level)


@dataclass(frozen=True)
class Call:
    """A call, or the head of a definition, laid out as `ruff format` does it.

    Attributes:
        head: what stands before the parenthesis.
        arguments: what stands in it.
    """

    head: str
    arguments: list[str | Call]

    def __str__(self) -> str:
        return f"{self.head}({', '.join(map(str, self.arguments))})"

    def laid_out(self, indent: int, before: str, after: str) -> list[str]:
        """Return the lines, indented by a number of spaces, with text before and after the call."""
        space, inner = " " * indent, " " * (indent + 4)
        if len(line := f"{space}{before}{self}{after}") <= WIDTH:
            return [line]
        lines = [f"{space}{before}{self.head}("]
        together = ", ".join(map(str, self.arguments))
        if len(inner + together) <= WIDTH:
            lines.append(inner + together)
        else:
            comma = "" if len(self.arguments) == 1 else ","
            for each in self.arguments:
                if isinstance(each, Call):
                    lines += each.laid_out(indent + 4, "", comma)
                else:
                    lines.append(f"{inner}{each}{comma}")
        return [*lines, f"{space}){after}"]


def parameters_of(arguments: ast.arguments) -> Iterator[str]:
    """Yield the parameters of a function as they are written."""
    assert not arguments.posonlyargs
    assert arguments.kwarg is None
    defaults = [None] * (len(arguments.args) - len(arguments.defaults)) + [*arguments.defaults]
    for each, default in zip(arguments.args, defaults, strict=True):
        yield parameter(each, default)
    if arguments.vararg is not None:
        yield "*" + parameter(arguments.vararg, None)
    elif arguments.kwonlyargs:
        yield "*"
    for each, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        yield parameter(each, default)


def parameter(each: ast.arg, default: ast.expr | None) -> str:
    kind = "" if each.annotation is None else f": {quoted(each.annotation)}"
    if default is None:
        return each.arg + kind
    return f"{each.arg}{kind}{' = ' if kind else '='}{quoted(default)}"


def quoted(value: ast.expr) -> str:
    """Return an annotation or a default as it is written, with double quotes."""
    return ast.unparse(value).replace("'", '"')


def arguments_of(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Return the arguments with which a blocking function calls the asynchronous one."""
    given = [passed(each) for each in node.args.args if each.arg != "self"]
    given += [] if node.args.vararg is None else [f"*{node.args.vararg.arg}"]
    return given + [f"{each.arg}={passed(each)}" for each in node.args.kwonlyargs]


def passed(each: ast.arg) -> str:
    """Return what is passed for a parameter: an asynchronous object, a copy of an iterable, or itself."""
    names = names_in(each.annotation)
    if "Component" in names:
        return f"wrapped_by({each.arg})"
    return f"own_values({each.arg})" if "Iterable" in names else each.arg


def names_in(node: ast.AST | None) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} if node is not None else set()


def import_order(name: str) -> tuple[int, str]:
    """The order of isort: constants, classes, functions."""
    plain = name.split(" as ", maxsplit=1)[0]
    return (0 if plain.isupper() and len(plain) > 1 else 1 if plain[0].isupper() else 2), plain


def items_of(text: str) -> Iterator[tuple[str, str, list[str]]]:
    """Split a docstring into paragraphs and entries of sections: both indentations, and the lines."""
    for number, paragraph in enumerate(text.split("\n\n")):
        if number:
            yield "", "", [""]
        lines = paragraph.split("\n")
        if re.fullmatch(r"[A-Z]\w+:", lines[0]):
            yield "", "", [lines.pop(0)]
            entries: list[list[str]] = []
            for line in lines:
                if line.startswith("        ") or (entries and not re.match(r" {4}\*?[\w, *]+:", line)):
                    entries[-1].append(line)
                else:
                    entries.append([line])
            for entry in entries:
                hanging = re.match(" *", entry[-1])
                assert hanging is not None
                yield "    ", hanging[0], [line.strip() for line in entry]
        else:
            yield "", "", lines


def attributes_in(doc: list[str]) -> Iterator[tuple[list[str], str]]:
    """Yield the names and the text of each entry in the section of attributes."""
    section = "\n".join(doc).partition("Attributes:\n")[2].partition("\n\n")[0]
    for entry in re.split(r"\n(?= {4}\w)", section):
        names, _, text = entry.partition(":")
        yield [name.strip() for name in names.split(",")], " ".join(text.split())


def filled(text: str, first: str, hanging: str, level: int) -> list[str]:
    """Return a text in lines, as they stand in a docstring of this level of indentation."""
    return textwrap.wrap(
        text,
        WIDTH - 4 * level,
        initial_indent=first,
        subsequent_indent=hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )


REST = '''

def _event(thread: ClientThread, event: asynchronous.Event) -> Event:
    """Return the blocking form of an event."""
    values: dict[str, Any] = {each.name: getattr(event, each.name) for each in fields(event)}
    return _EVENTS[type(event)](**values | {"component": Component.of(thread, event.component)})


def _components(thread: ClientThread, client: AsyncParamClient) -> Mapping[Address, Component]:
    """Return a view of the components of a client."""

    def find(address: Address) -> Component | None:
        found = thread.read(lambda: client.components.get(address))
        return None if found is None else Component.of(thread, found)

    def copy() -> Mapping[Address, Component]:
        found = thread.read(lambda: dict(client.components))
        return {address: Component.of(thread, each) for address, each in found.items()}

    return LiveMapping(find, copy)
'''


def blocking_source() -> str:
    """Return the text of `paramclient/sync/blocking.py`."""
    return Writer().source()


if __name__ == "__main__":
    BLOCKING.write_text(blocking_source(), encoding="utf-8")

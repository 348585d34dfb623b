"""Documents as answers: made and written out in a worker thread, a long one member by member."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterable, Iterator
from typing import Any, Final, TypeAlias

from fastapi import Response

from paramclient.documents.document import Document
from paramclient.service.event_feed import COMPACT

__all__ = ["JSON", "Aside", "document_answer", "written_out"]

JSON: Final = "application/json"
LONG_MEMBER: Final = 64
"""Entries of a member that is written out as a whole; those of a longer one are written one by one."""

Aside: TypeAlias = Callable[[Callable[[], bytes]], Awaitable[bytes]]
"""Does something in a thread, such as `Hub.aside`."""


async def document_answer(aside: Aside, make: Callable[[], Document], *, status: int = 200) -> Response:
    """An answer with a document.

    Args:
        aside: does what takes long in a thread.
        make: makes the document, there.
        status: HTTP's number.

    Raises:
        Exception: whatever `make` raises.
    """
    return Response(await aside(lambda: written_out(make())), status, media_type=JSON)


def written_out(document: Document, **entries: Iterable[Document | tuple[str, Document]]) -> bytes:
    """A document as JSON, as `model_dump_json` gives it.

    That would keep the interpreter for as long as it takes, which is long for thousands of entries.

    Args:
        document: what to write.
        entries: by the name of a member that is a list or an object, its entries in place of those of the
            document, those of an object with their names; each is made, written and forgotten before the
            next one.
    """
    return ("{" + ",".join(filter(None, _members(document, entries))) + "}").encode()


def _members(
    document: Document, entries: dict[str, Iterable[Document | tuple[str, Document]]]
) -> Iterator[str]:
    for name, field in type(document).model_fields.items():
        key = json.dumps(field.serialization_alias or name)
        if name in entries:
            is_object = isinstance(getattr(document, name), dict)
            texts = ",".join(map(_entry, entries[name]))
            yield f"{key}:{{{texts}}}" if is_object else f"{key}:[{texts}]"
            continue
        content = getattr(document, name)
        if isinstance(content, dict) and len(content) > LONG_MEMBER:
            pairs = [f"{json.dumps(str(each))}:{_json(value)}" for each, value in content.items()]
            yield f"{key}:{{{','.join(pairs)}}}"
        elif isinstance(content, list) and len(content) > LONG_MEMBER:
            yield f"{key}:[{','.join(map(_json, content))}]"
        else:
            yield document.model_dump_json(include={name})[1:-1]


def _entry(entry: Document | tuple[str, Document]) -> str:
    if isinstance(entry, Document):
        return entry.model_dump_json()
    name, document = entry
    return f"{json.dumps(name)}:{document.model_dump_json()}"


def _json(content: Any) -> str:
    if isinstance(content, Document):
        return content.model_dump_json()
    return json.dumps(content, allow_nan=False, separators=COMPACT)

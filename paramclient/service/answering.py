"""Documents as answers: made and written out in a worker thread, a long one member by member."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from fastapi import Response

from paramclient.documents.document import Document
from paramclient.provision.runner import Runner
from paramclient.service.event_feed import COMPACT

__all__ = ["JSON", "document_answer", "written_out"]

JSON: Final = "application/json"
LONG_MEMBER: Final = 64
"""Entries of a member that is written out as a whole; those of a longer one are written one by one."""


async def document_answer(run: Runner, make: Callable[[], Document], *, status: int = 200) -> Response:
    """An answer with a document.

    Args:
        run: runs what takes long, such as `Hub.aside`.
        make: makes the document, there.
        status: HTTP's number.

    Raises:
        Exception: whatever `make` raises.
    """
    return Response(await run(lambda: written_out(make())), status, media_type=JSON)


def written_out(document: Document, **entries: Iterable[Document]) -> bytes:
    """A document as JSON, as `model_dump_json` gives it.

    That would keep the interpreter for as long as it takes, which is long for thousands of entries.

    Args:
        document: what to write.
        entries: by the name of a member that is a list, what stands in it in place of what the document has;
            each is made, written and forgotten before the next one.
    """
    return ("{" + ",".join(filter(None, _members(document, entries))) + "}").encode()


def _members(document: Document, entries: dict[str, Iterable[Document]]) -> Iterator[str]:
    for name, field in type(document).model_fields.items():
        key = json.dumps(field.serialization_alias or name)
        if name in entries:
            yield f"{key}:[{','.join([each.model_dump_json() for each in entries[name]])}]"
            continue
        content = getattr(document, name)
        if isinstance(content, dict) and len(content) > LONG_MEMBER:
            pairs = [f"{json.dumps(str(each))}:{_json(value)}" for each, value in content.items()]
            yield f"{key}:{{{','.join(pairs)}}}"
        elif isinstance(content, list) and len(content) > LONG_MEMBER:
            yield f"{key}:[{','.join(map(_json, content))}]"
        else:
            yield document.model_dump_json(include={name})[1:-1]


def _json(content: Any) -> str:
    if isinstance(content, Document):
        return content.model_dump_json()
    return json.dumps(content, allow_nan=False, separators=COMPACT)

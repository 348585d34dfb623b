"""Problem documents: errors of the service in the format of RFC 9457."""

from __future__ import annotations

from pydantic import ConfigDict

from paramclient.documents.document import Document, Maybe

__all__ = ["Problem"]


class Problem(Document):
    """A problem document: `type` is a name for programs, `detail` a sentence for users.

    `error` is the name of the library's exception, if there is one; its attributes are further members.
    """

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str
    error: Maybe[str] = None

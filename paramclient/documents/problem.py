"""Why something was not done, as RFC 9457 has it."""

from __future__ import annotations

from pydantic import ConfigDict

from paramclient.documents.document import Document, Maybe

__all__ = ["Problem"]


class Problem(Document):
    """A problem document: `type` is a name for programs, `detail` the sentence for people.

    `error` is the name of the library's exception where there is one; what that knows besides stands beside
    it under its own names.
    """

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str
    error: Maybe[str] = None

"""What is told as JSON: the command prints these documents, the service sends them.

Each is built by `of(…)` from what the library gives. This room loads pydantic: import it where JSON is made.
"""

from __future__ import annotations

from paramclient.documents.base import Body, Document, Maybe, Scalar
from paramclient.documents.param import InfoDoc, ParamDoc, WrittenParamDoc

__all__ = ["Body", "Document", "InfoDoc", "Maybe", "ParamDoc", "Scalar", "WrittenParamDoc"]

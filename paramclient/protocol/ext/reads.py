"""PARAM_EXT_REQUEST_READ."""

from __future__ import annotations

from typing import TypeAlias

from paramclient.protocol.params.reads import Key, ValueRead, ValueReads
from paramclient.protocol.wire import Message, ParamExtRequestRead, ParamExtValue

__all__ = ["ExtRead", "ExtReads"]

ExtRead: TypeAlias = ValueRead[ParamExtValue]
"""One PARAM_EXT_REQUEST_READ and its response."""


class ExtReads(ValueReads[ParamExtValue]):
    """The PARAM_EXT_REQUEST_READs to one component; see `ValueReads`."""

    _what = "extended parameter"

    def _message_for(self, key: Key) -> Message:
        if isinstance(key, int):
            return ParamExtRequestRead(*self._target, "", key)
        return ParamExtRequestRead(*self._target, key, -1)

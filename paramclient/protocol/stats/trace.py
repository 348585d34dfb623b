"""Trace lines of the core's steps for debugging, formatted only where tracing is on."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from paramclient.protocol.wire import (
    CommandLong,
    FileTransfer,
    Message,
    ParamExtRequestList,
    ParamExtRequestRead,
    ParamExtSet,
    ParamRequestList,
    ParamRequestRead,
    ParamSetMessage,
)

__all__ = ["LazyMessageText", "Trace", "discard"]

Trace: TypeAlias = Callable[..., None]
"""Takes a %-format and its arguments, as `logging.Logger.debug` does."""


def discard(text: str, *details: object) -> None:
    """Discard the line."""


class LazyMessageText:
    """A message as text, formatted on demand; of types not listed here, such as a key, only the type."""

    __slots__ = ("_message",)

    def __init__(self, message: Message) -> None:
        self._message = message

    def __str__(self) -> str:
        match self._message:
            case ParamRequestRead(param_id=name, param_index=index):
                return f"PARAM_REQUEST_READ {name if index < 0 else index}"
            case ParamRequestList():
                return "PARAM_REQUEST_LIST"
            case ParamSetMessage(param_id=name, raw=raw, param_type=number):
                return f"PARAM_SET {name} to {raw.hex()} of type {number}"
            case ParamExtRequestRead(param_id=name, param_index=index):
                return f"PARAM_EXT_REQUEST_READ {name if index < 0 else index}"
            case ParamExtRequestList():
                return "PARAM_EXT_REQUEST_LIST"
            case ParamExtSet(param_id=name, raw=raw, param_type=number):
                return f"PARAM_EXT_SET {name} to {raw.hex()} of type {number}"
            case CommandLong(command=command, params=params):
                return f"COMMAND_LONG {command} ({params[0]:g})"
            case FileTransfer(payload=payload):
                return f"FILE_TRANSFER_PROTOCOL operation {payload[3]}"
            case message:
                return type(message).__name__

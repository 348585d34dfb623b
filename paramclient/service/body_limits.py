"""Limits of request bodies: sizes by path, per holder and in total, and what is counted before parsing.

`access` enforces the limits of each body while it is received, with the size that `request` finds for the
path; `body_memory` those of all bodies. `request_body` and `param_sources` check the content before parsing.
"""

from __future__ import annotations

from typing import Final

__all__ = [
    "BODY_BYTES_MAX_BY_PATH",
    "DIGITS_MAX",
    "HOLDER_BODY_BYTES_MAX",
    "LINE_BYTES_MAX",
    "METADATA_BYTES_MAX",
    "PARAM_FILE_BYTES_MAX",
    "PLAIN_BODY_BYTES_MAX",
    "SEPARATORS_MAX",
    "SESSION_BODY_BYTES_MAX",
    "SHORT_BODY_BYTES_MAX",
    "TOTAL_BODY_BYTES_MAX",
    "VALUES_BODY_BYTES_MAX",
]

PLAIN_BODY_BYTES_MAX: Final = 64 * 1024
"""Maximum size in bytes of a body without values or files."""
VALUES_BODY_BYTES_MAX: Final = 3 * 1024 * 1024
"""Maximum size in bytes of a body with values, or with files in JSON: the largest file in base64, and other
members."""
PARAM_FILE_BYTES_MAX: Final = 2 * 1024 * 1024
"""Maximum size of a parameter file in bytes: ten thousand parameters in the longest format. Parsing a larger
file would take half of the processor for more than some seconds."""
METADATA_BYTES_MAX: Final = 8 * 1024 * 1024
"""Maximum size of a metadata file in bytes: ArduPilot's file of one vehicle has half of it."""
BODY_BYTES_MAX_BY_PATH: Final = {
    ("POST", "apply"): VALUES_BODY_BYTES_MAX,
    ("POST", "diff"): VALUES_BODY_BYTES_MAX,
    ("POST", "plan"): VALUES_BODY_BYTES_MAX,
    ("POST", "verify"): VALUES_BODY_BYTES_MAX,
    ("PATCH", "params"): VALUES_BODY_BYTES_MAX,
    ("POST", "files"): PARAM_FILE_BYTES_MAX,
    ("PUT", "metadata"): METADATA_BYTES_MAX,
}
"""Maximum size in bytes of bodies with values or files, by method and the last part of the path."""
SESSION_BODY_BYTES_MAX: Final = 1_024
"""Maximum size in bytes of a body that starts a session: the only body accepted without a token."""
TOTAL_BODY_BYTES_MAX: Final = 64 * 1024 * 1024
"""Maximum number of bytes of all bodies that are received or whose requests are in progress."""
HOLDER_BODY_BYTES_MAX: Final = 16 * 1024 * 1024
"""Maximum number of bytes of the bodies of one holder. Four holders can occupy the total."""
SHORT_BODY_BYTES_MAX: Final = 4096
"""Maximum size in bytes of a body that is parsed in the event loop, which is faster than a thread."""
SEPARATORS_MAX: Final = 60_000
"""Maximum number of commas, opening brackets and line ends of a body or file, which bounds its values,
members and lines. A file of eight thousand parameters in JSON, the longest format, has 56,000."""
DIGITS_MAX: Final = 256
"""Maximum number of consecutive digits in a JSON body: 128 bytes in hexadecimal digits may have as many.
A body full of such numbers is parsed in 18 ms; parsing a single one of 4,300 takes 0.6 ms, with the GIL
held."""
LINE_BYTES_MAX: Final = 16_384
"""Maximum length in bytes of a line of a file that is not JSON: each line is searched for comments at
once."""

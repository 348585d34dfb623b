"""Parameter files: formats of QGroundControl, MAVProxy and Mission Planner, packed files, JSON.

- `formats`: the known formats, and the content of a file.
- `conversion`, `disk`: from and to bytes, reading and replacing a file.
- `line_formats`, `param_pck`, `json_format`: lists of ground stations, packed files, JSON.
- `rename_file`: files of names that firmware versions have changed.
- `text`, `includes`, `json_reader`: lines and bad lines, `@include` lines, fields of JSON.
"""

from paramclient.files.conversion import LARGEST_FILE, dumps, loads
from paramclient.files.disk import read_file, write_file
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.files.rename_file import loads_renames, read_renames

__all__ = [
    "LARGEST_FILE",
    "FileFormat",
    "ParamFile",
    "dumps",
    "loads",
    "loads_renames",
    "read_file",
    "read_renames",
    "write_file",
]

"""Parameter files: formats of QGroundControl, MAVProxy, Mission Planner and PX4, packed files, JSON, YAML.

- `formats`, `param_file`: the known formats, the content of a file.
- `conversion`, `disk`: from and to bytes, reading and replacing a file.
- `line_formats`: QGroundControl, MAVProxy, Mission Planner. `script`, `param_pck`, `document_format`,
  `document_schema`: PX4's scripts, packed files, JSON and YAML.
- `extended_document`: files of extended parameters.
- `rename_file`: files of names that firmware versions have changed.
- `text`, `includes`, `yaml_parser`: lines and bad lines, `@include` lines, YAML with JSON's rules.
"""

from paramclient.files.conversion import LARGEST_FILE, dumps, loads
from paramclient.files.disk import read_file, write_file
from paramclient.files.formats import FileFormat
from paramclient.files.param_file import ParamFile
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

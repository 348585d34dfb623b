"""Parameter files: formats of QGroundControl, MAVProxy and Mission Planner, packed files, JSON.

- `formats`: the known formats, and the content of a file.
- `conversion`: the table of formats: recognizing, reading and writing; packed files; files that are mistaken
  for parameter files. `disk`: reading and replacing files.
- `lists`, `json_format`: lists of ground stations, JSON.
- `reading`: one file while it is read: its text, its parameters, its notes and its faults.
"""

from paramclient.files.conversion import dumps, loads, read_file, writable, write_file
from paramclient.files.disk import LARGEST_FILE
from paramclient.files.formats import FileFormat, ParamFile

__all__ = [
    "LARGEST_FILE",
    "FileFormat",
    "ParamFile",
    "dumps",
    "loads",
    "read_file",
    "writable",
    "write_file",
]

"""Parameter files of every ground station: QGroundControl, MAVProxy, Mission Planner, packed, our own."""

from paramclient.files.disk import read_file, write_file
from paramclient.files.formats import LARGEST_FILE, dumps, loads
from paramclient.files.param_file import FileForm, ParamFile

__all__ = ["LARGEST_FILE", "FileForm", "ParamFile", "dumps", "loads", "read_file", "write_file"]

"""Parameter files: formats of QGroundControl, MAVProxy, Mission Planner and PX4, packed files, JSON, YAML."""

from paramclient.files.disk import read_file, write_file
from paramclient.files.formats import LARGEST_FILE, dumps, loads
from paramclient.files.param_file import FileForm, ParamFile

__all__ = ["LARGEST_FILE", "FileForm", "ParamFile", "dumps", "loads", "read_file", "write_file"]

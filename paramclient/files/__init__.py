"""Parameter files of every ground station: QGroundControl, MAVProxy, Mission Planner, packed, our own."""

from paramclient.files.disk import read_file, write_file
from paramclient.files.forms import LARGEST_FILE, dumps, loads
from paramclient.files.model import FileForm, ParamFile

__all__ = ["LARGEST_FILE", "FileForm", "ParamFile", "dumps", "loads", "read_file", "write_file"]

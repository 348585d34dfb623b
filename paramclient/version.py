"""The version number, read by packaging, the command line and the documentation."""

__version__ = "0.1.0"

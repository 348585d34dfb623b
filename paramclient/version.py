"""The one place where the version stands; packaging, the command and the documents read it here."""

__version__ = "0.1.0"

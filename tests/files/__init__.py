"""Tests of `paramclient/files`."""

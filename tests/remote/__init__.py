"""Tests of `paramclient/remote`."""

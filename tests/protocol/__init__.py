"""Tests of `paramclient/protocol`."""

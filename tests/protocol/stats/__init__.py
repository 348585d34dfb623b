"""Tests of `paramclient/protocol/stats`."""

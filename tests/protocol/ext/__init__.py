"""Tests of `paramclient/protocol/ext`."""

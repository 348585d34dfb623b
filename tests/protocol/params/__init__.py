"""Tests of `paramclient/protocol/params`."""

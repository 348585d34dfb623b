"""Tests of `paramclient/protocol/requests`."""

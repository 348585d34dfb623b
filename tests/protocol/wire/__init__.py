"""Tests of `paramclient/protocol/wire`."""

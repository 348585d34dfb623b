"""Tests of `paramclient/protocol/vehicle`."""

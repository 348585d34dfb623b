"""Tests of `paramclient/sync`."""

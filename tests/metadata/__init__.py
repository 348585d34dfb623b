"""Tests of `paramclient/metadata`."""

"""Tests of `paramclient/model`."""

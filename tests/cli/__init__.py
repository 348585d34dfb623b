"""Tests of `paramclient/cli`."""

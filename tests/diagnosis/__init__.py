"""Tests of `paramclient/diagnosis`."""

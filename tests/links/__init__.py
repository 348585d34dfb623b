"""Tests of `paramclient/links`."""

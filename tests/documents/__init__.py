"""Tests of `paramclient/documents`."""

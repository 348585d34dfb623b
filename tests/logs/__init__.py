"""Tests of `paramclient/logs`."""

"""Tests of `paramclient/service`."""

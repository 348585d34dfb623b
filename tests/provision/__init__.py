"""Tests of `paramclient/provision`."""

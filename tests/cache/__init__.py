"""Tests of `paramclient/cache`."""

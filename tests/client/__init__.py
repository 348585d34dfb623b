"""Tests of `paramclient/client`."""

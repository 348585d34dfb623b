"""Tests of `paramclient/protocol/ftp`."""

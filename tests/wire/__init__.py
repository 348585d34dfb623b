"""Tests of `paramclient/wire`."""

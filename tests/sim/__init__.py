"""Tests of `paramclient/sim`."""

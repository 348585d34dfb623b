"""Checks of the client on any vehicle, real or simulated, by its link: `python -m tests.live LINK`."""

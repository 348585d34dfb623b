"""Identification, presence, commands, reboot and system id of a vehicle."""

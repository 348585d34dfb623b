"""Identification, presence, commands, reboot and peers of a vehicle.

`address_contest`: the peers of a component, and contested addresses. The text is `errors.ContestedAddress`.
`boot_time_requests`: requests for SYSTEM_TIME.
`boot_time_sampling`: reads of clocks in telemetry.
`commands`: COMMAND_LONG, and the messages that are requested with it.
`extended_kinds`: kinds of components with extended parameters.
`identification`: identity and parameter encoding.
`kinds`: autopilots and vehicle types as text.
`metadata_request`: COMPONENT_METADATA, with the location of the metadata that `metadata.download` loads.
`peer_claims`: what one peer sends under an address.
`presence`: heartbeats, silence, loss.
`reboot_detection`: reboots, by heartbeats and times since boot.
`reboot_command`: a reboot on command.
"""

"""The sans-I/O core: no socket, no clock, no disk; bytes and the time are arguments.

`station`: one link: components, our heartbeat, routing of messages.
`component`: one component: its state and its machines.
`events`: events of the components.
`scheduler`: many components on one link: which are due, and whose lists run.
`addresses`: addresses of components and peers.
`vehicle_selection`: the only vehicle that an incomplete address fits.
`no_reply_hint`: the hint of a `NoReply`: what was heard on a link instead of the awaited response.
`system_id_change`: the search for a vehicle under a new system id.
`wire`: frames, messages, signatures.
`params`: the parameter protocol.
`ext`: the extended parameter protocol.
`requests`: timeouts, retries and pacing.
`vehicle`: identification, presence, commands, reboot.
`ftp`: MAVFTP.
`stats`: traffic and packet loss.
"""

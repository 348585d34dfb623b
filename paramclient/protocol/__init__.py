"""The conversations with the components on one link, as async functions without input and output.

- `station`, `node`, `session`: all components of a link; one component; its plain or extended parameters.
- `channel`: requests of one component, and the messages that answer them; timeouts, round trip and loss.
- `dialect`: the messages of the plain and of the extended protocol.
- `table`: the values of a component with their trust, the count, the hash.
- `reads`, `writes`, `set_results`: single reads; writes, and their results.
- `fetch`, `list_download`, `file_download`: all parameters: from the cache, by list, as a file.
- `ftp`, `param_pck`: MAVFTP; the packed parameter file.
- `digest`, `checksum`, `watch`: whether the table is current, by hash or checksum; checks of it.
- `identity`, `presence`: who the vehicle is, and of which kind; lost, found, rebooted.
- `commands`: COMMAND_LONG, requested messages, reboots.
- `selection`: the vehicle that a call without an address means.
- `addresses`: addresses and peers.
"""

"""The parameter protocol of one component: table, reads, writes, downloads, hash check, sync.

`change`: a change of one parameter.
`change_origin`: the author of a change.
`fetch`: one fetch: cache, file or list.
`fetch_notes`: the sentences of `FetchResult.notes`.
`fetch_queue`: the fetches of a component, one at a time.
`fetch_result`: policy, progress and result of a fetch.
`file_download`: the packed parameter file over MAVFTP.
`hash_check`: what an announced hash proves about a downloaded table.
`list_download`: PARAM_REQUEST_LIST and the repair of its gaps.
`list_stream`: progress, pace, losses and end of a running list.
`passive`: tables from the traffic of other stations, and from logs.
`reads`: PARAM_REQUEST_READ.
`sync`: detection of changes that were missed.
`table`: the parameters, their trust and their hash.
`value_check`: values that may be older than a change.
`volatile_values`: reads of the values that a hash does not cover.
`write_batch`: many PARAM_SETs in one call: which are sent next, and the outcome of each.
`small_changes`: changes too small for PX4 to save.
`writes`: one PARAM_SET until its value is confirmed, and its repetition; how often is in `requests.retry`.
"""

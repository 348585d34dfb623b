"""The policy of all requests: timeouts, retries and pacing.

`bulk_writes`: many writes in one call, with one outcome for each.
`context`: the facts that the machines of a component share.
`machine`: the lifecycle of these machines.
`operation`: an operation with one result or error.
`pacing`: the rate limit of reads.
`retry`: timeouts, number of attempts, backoff, and the end of every kind of request.
`round_trip`: the measured round-trip time and packet loss.
`write_window`: the number of PARAM_SETs in flight.
"""

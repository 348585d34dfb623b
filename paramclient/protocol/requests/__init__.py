"""The policy of all requests: timeouts, retries and pacing.

`context`: the facts that the machines of a component share.
`machine`: the lifecycle of these machines.
`operation`: an operation with one result or error.
`pacing`: the rate limit of requests.
`round_trip`: round-trip time, timeouts, packet loss, number of attempts.
"""

"""The tests: what each room does, with the time passed in or with real sockets, on any machine."""

from hypothesis import HealthCheck, settings

# how long an example takes says something of the machine, and nothing of what is tested
settings.register_profile(
    "any machine", settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")

"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation."""

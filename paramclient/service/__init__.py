"""The cache service: one process holds the links, and everyone on the network uses them over HTTP."""

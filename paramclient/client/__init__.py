"""The client over one link: client, component, link task, cache writer, events, files, signing."""

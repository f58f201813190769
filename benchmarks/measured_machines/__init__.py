"""B9: searches on the measured machines of the registry, in one process per direction, and their page."""

"""Measured machines of the registry, how their recordings are parted, and what a search makes of them."""

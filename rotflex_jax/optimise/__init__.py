"""Minimisers that know nothing of recordings."""

"""Minimisers that are independent of recordings and models."""

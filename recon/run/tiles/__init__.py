"""Reconstructions of fields that are larger than memory, tile by tile."""

"""A reconstruction from a configuration to a folder of results."""

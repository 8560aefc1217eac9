"""The commands that begin with a recording instead of a configuration."""

"""The command that looks after an installation: what it holds, and whether it computes what it should."""

"""Whether the values of a configuration can be: those that are impossible, and those that are likely wrong."""

"""What the command line returns where it doesn't return 0."""

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

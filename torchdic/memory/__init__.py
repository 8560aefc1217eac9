"""Memory: how much is free, how much a computation holds, and how it is limited. Nothing here depends on optics."""

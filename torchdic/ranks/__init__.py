"""Several processes that compute together, called ranks."""

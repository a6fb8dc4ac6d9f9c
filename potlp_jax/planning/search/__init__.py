"""The search over histories: what to attempt first, what next after success and after failure."""

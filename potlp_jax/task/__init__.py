"""A formula becomes arrays (host only)."""

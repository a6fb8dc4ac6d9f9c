"""Where worlds come from: one file a family, each a ``Generator``; ``registry.make`` finds them by name."""

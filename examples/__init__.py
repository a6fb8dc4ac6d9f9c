"""Small programs on the public names of the library; each runs by itself, as ``python -m examples.NAME``."""

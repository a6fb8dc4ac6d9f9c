"""Shortest distances and paths through map and automaton."""

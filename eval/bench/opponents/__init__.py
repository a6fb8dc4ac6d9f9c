"""Planners by others on our planning problems, and careful versions of published algorithms, to compare with."""

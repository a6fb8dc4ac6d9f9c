"""The optimum of a planning problem, or bounds on it: the yardstick of the search."""

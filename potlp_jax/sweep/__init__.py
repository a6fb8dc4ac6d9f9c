"""Thousands of paired trials: what to run, where rows are kept, what they say."""

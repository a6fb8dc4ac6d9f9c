"""The settings that are best for each policy: what is tried, trials, the choice, the report."""

"""Checks that share no code with the planner: a formula's semantics, and an auditor of trials."""

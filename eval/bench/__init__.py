"""Benchmarks of the planner: regret over CPU time, throughput, distances."""

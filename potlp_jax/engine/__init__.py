"""Engines: where units of work run, in this process, in processes of this machine, or on a cluster (docs/clusters.md).

Sweeps and collections are made of units: pure, deterministic pieces of work, whose results are the same wherever and
however often they run. Whoever asks an engine is the only one that writes results anywhere.
"""

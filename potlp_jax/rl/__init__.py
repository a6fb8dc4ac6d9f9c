"""Trials as environments for reinforcement learning: ``episodes`` in pure JAX, ``gym`` for gymnasium."""

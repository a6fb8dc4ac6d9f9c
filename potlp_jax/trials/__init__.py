"""Algorithm 1 of Bradley et al. 2021: observe, decide, advance."""

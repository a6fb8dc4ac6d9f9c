"""What each part of the fire-fighting estimator is good for: networks without it, in answers and in trials."""

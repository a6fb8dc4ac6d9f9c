"""How an estimator is made: buildings explored, a dataset collected, a network fitted, as a recipe says."""

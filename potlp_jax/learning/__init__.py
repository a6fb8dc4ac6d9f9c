"""The paper's section IV: the estimator, from labels to training to answers."""

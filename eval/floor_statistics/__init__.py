"""What generated floors are like beside real ones: ``python -m eval.floor_statistics --help``."""

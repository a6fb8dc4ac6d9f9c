"""Worlds on maps that robots made: reading, cleaning, surveying and labelling them."""

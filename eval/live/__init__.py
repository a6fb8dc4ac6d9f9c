"""Robots behind rosbridge, tried with a simulator that says what a robot would, over a network that does what it likes.

``python -m eval.live`` counts how 1,000 perturbed streams end; ``--help`` tells what can be set.
"""

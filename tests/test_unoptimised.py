"""Modules that are not marked ``optimised`` are compiled fast, and so are the processes they start."""

from tests.test_optimiser import contractions, contractions_of_a_process


def test_the_optimiser_is_off():
    assert contractions() == 0
    assert contractions_of_a_process() == 0

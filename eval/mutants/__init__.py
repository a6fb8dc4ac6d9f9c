"""Do the tests notice faults of the core? Each mutant is one small fault, made on purpose in a copy of the tree.

``core`` lists the mutants, and the tests that are expected to fail for each; ``python -m eval.mutants`` runs them.
"""

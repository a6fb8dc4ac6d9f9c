"""``python -m potlp_jax.native``: build all kernels ahead of use, and say what is used and why not.

The exit status is 0 where all of them are used.
"""

import sys

from potlp_jax.native import status


def main() -> int:
    """Print one line a library."""
    libraries = status()
    for library in libraries:
        if library.file is None:
            print(f"{library.name}: JAX twin, because {library.reason}")
        else:
            print(f"{library.name}: native, {library.file} ({library.seconds:.1f} s)")
    return 0 if all(library.file is not None for library in libraries) else 1


if __name__ == "__main__":
    sys.exit(main())

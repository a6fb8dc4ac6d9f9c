"""Planners by others on our planning problems, and careful versions of published algorithms, to compare with."""

import importlib.util
from collections.abc import Iterable

NEEDS: dict[str, list[str]] = {
    "po-uct-numba": ["numba"],
    "po-uct-pomdp-py": ["numba", "pomdp_py"],
    "mctx": ["mctx"],
}
"""Modules that an opponent needs beyond the library's own dependencies; the extra 'bench' brings them."""


def installed(names: Iterable[str]) -> list[str]:
    """The planners that can run here; says which others are left out and why."""
    found = []
    for name in names:
        missing = [module for module in NEEDS.get(name, ()) if importlib.util.find_spec(module) is None]
        if missing:
            print(f"{name} is left out: {', '.join(missing)} is not installed (extra 'bench')")
        else:
            found.append(name)
    return found

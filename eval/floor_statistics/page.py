"""The page of results: tables of what was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

QUANTILES = (0.1, 0.5, 0.9)

_MEASURES = {
    "long_side": "long side, m",
    "short_side": "short side, m",
    "area": "free area, m²",
    "free": "free share of the rectangle",
    "rooms": "rooms",
    "room_areas": "room, m²",
    "middle_room": "median room of a floor, m²",
    "hallway_share": "hallways' share of the area",
    "longest_hallway": "longest straight line in hallways, m",
    "hallway_width": "hallway's width, m",
    "doors_per_room": "doors per room",
    "room_loops": "loops through rooms",
    "hallway_loops": "loops of hallways",
    "dead_ends": "ends of hallways",
    "frontiers": "frontiers after 20 m",
}
_TOGETHER = ("plans", "generated", "delivery")
_BY_SIZE = ("plans to 64 m", "small", "plans from 64 m", "medium", "large")


def page_of(data: Mapping[str, Any]) -> str:
    """The page in Markdown, before ``eval.provenance`` writes its lines."""
    groups, walls = data["groups"], data["walls"]
    return f"""# Generated floors beside real ones

**Question.** Are the floors of `campus-small`, `campus-medium` and `campus-large` as large, as divided and as
connected as real ones?

**Answer.** In the middle, mostly: ten of 15 medians are within a quarter of those of real plans, but only five measures
are so at 10, 50 and 90 % alike. They differ in this: the generator also has buildings 1.7 times as long as the plans,
as the walls of the KTH campus are, with longer hallways and more rooms; rooms are smaller in the middle and at the
large end, and closets larger; all together the generated ones differ more from one another in size, rooms, loops and
frontiers, while those of one family differ less than plans of its size in about half of the measures; real hallways are
wider, halls among them. Sizes and shapes of the generator were set with these tables in view; trials on plans were not
looked at.

```sh
python -m eval.floor_statistics                       # this page and its data
python -m eval.floor_statistics --sheet sheet.png     # twelve generated floors beside twelve plans
```

`plans` are {groups["plans"]["floors"]} school and office buildings of M. Luperto's corpora, rasterised with cells of
0.5 m; `generated` are {groups["generated"]["floors"]} training worlds of the three families together; `delivery` are
those of the generator of rectangles. No plan is part of the repository, nor a picture of one.

## All together

{_table(groups, _TOGETHER)}
<!-- made: floors.json -->

## By size

A long side of 64 m divides small buildings from medium ones, 128 m medium from large ones, of which the plans have
one.

{_table(groups, _BY_SIZE)}
<!-- made: floors.json -->

Buildings of which only walls are known are larger. In brackets, how many there are:

{_walls_table(walls)}
<!-- made: floors.json -->

Of 161 floors of the KTH campus the long side is 42, 111 and 222 m at 10, 50 and 90 % (Aydemir et al. 2012).

**How it is measured.** A hallway is whatever a plan calls corridor, hall, lobby or entrance; hallways that touch are
one. Loops through rooms are the rank of the cycles of the graph whose nodes are rooms and hallways. Loops of hallways
go around a piece of the building of at least 9 m². An end of a hallway is 1 to 4 m wide with walls on three sides.
Frontiers are those that are open after a walk of 20 m through hallways, from a cell drawn uniformly, components of
one cell included.

## What buildings have

Share of the floors that have it, in %:

{_shares_table(groups)}
<!-- made: floors.json -->

## What large arrays cost

One small building in arrays of each family's size, so that nothing differs but the padding. The belief and the
painting are what a robot remembers; the last column is the first stage of the building network, per decision. Times
are those of one core.

{_costs_table(data["costs"])}
<!-- made: floors.json -->

That is why there are three families and not one: in arrays of the large one, a decision in a small building would
cost {_ratio(data["costs"]):.0f} times as much (observe, assess and paint together).
"""


def _table(groups: Mapping[str, Any], names: Sequence[str]) -> str:
    titles = [f"{name} ({groups[name]['floors']})" for name in names]
    head = [f"| 10, 50, 90 % | {' | '.join(titles)} |"]
    rows = [
        f"| {title} | {' | '.join(_quantiles(groups[name]['measures'][measure]) for name in names)} |"
        for measure, title in _MEASURES.items()
    ]
    return _joined(head, len(names), rows)


def _walls_table(walls: Mapping[str, Any]) -> str:
    rows = [
        f"| {name} ({sides['floors']}) | {_quantiles(sides['long_side'])} | {_quantiles(sides['short_side'])} |"
        for name, sides in walls.items()
    ]
    return _joined(["| 10, 50, 90 % | long side, m | short side, m |"], 2, rows)


def _shares_table(groups: Mapping[str, Any]) -> str:
    names = [name for name in groups if groups[name]["shares"]]
    entries = list(dict.fromkeys(entry for name in names for entry in groups[name]["shares"]))
    shares = {entry: [f"{100 * groups[name]['shares'].get(entry, 0):.0f}" for name in names] for entry in entries}
    rows = [f"| {entry} | {' | '.join(found)} |" for entry, found in shares.items()]
    return _joined([f"| | {' | '.join(names)} |"], len(names), rows)


def _costs_table(costs: Mapping[str, Any]) -> str:
    phases = list(next(iter(costs.values()))["milliseconds"])
    head = (
        f"| | array | {' | '.join(f'{phase}, ms' for phase in phases)} | belief and painting, MB | first stage, GFLOP |"
    )
    rows = [
        f"| {name} | {cost['shape'][0]} × {cost['shape'][1]} | "
        + " | ".join(f"{cost['milliseconds'][phase]:.2g}" for phase in phases)
        + f" | {cost['bytes'] / 1e6:.2g} | {cost['first_stage_operations'] / 1e9:.2g} |"
        for name, cost in costs.items()
    ]
    return _joined([head], len(phases) + 3, rows)


def _ratio(costs: Mapping[str, Any]) -> float:
    """How much more all phases of a robot's own cost in the large array than in the small one."""
    own = ("observe", "assess", "paint")
    large, small = (sum(costs[name]["milliseconds"][phase] for phase in own) for name in ("large", "small"))
    return large / small


def _joined(head: list[str], columns: int, rows: list[str]) -> str:
    return "\n".join([*head, "|---" * (columns + 1) + "|", *rows, ""])


def _quantiles(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.0f}" if value >= 20 else f"{value:.2g}" for value in values)

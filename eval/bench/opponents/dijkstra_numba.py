"""Dijkstra's algorithm on the product of a grid and an automaton, compiled by numba: opponents of the benchmark.

Two queues, both single-threaded and in float32, with the graph left implicit: nodes are ``z * H * W + cell``, the moves
of a cell are eight bits prepared once per map, and a move's state is looked up on the way. Nothing is allocated while
a source is solved. numba is a tool of the benchmark, not of the library: ``pip install potlp-jax[bench]``.

References:
  E. W. Dijkstra, A note on two problems in connexion with graphs, Numerische Mathematik 1, 1959.
  R. B. Dial, Algorithm 360: Shortest-path forest with topological ordering, CACM 12, 1969 (buckets).
"""

import dataclasses
import importlib
import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from potlp_jax.world.moves import NEIGHBOURS

numba: Any = importlib.import_module("numba")
"""By name: an optional package."""

_STEPS = np.array([1.0 if 0 in offset else math.sqrt(2.0) for offset in NEIGHBOURS], np.float32)


@dataclasses.dataclass(frozen=True)
class ProductGrid:
    """A product graph, and room for the queues.

    ``moves`` has bit ``k`` set where the move ``NEIGHBOURS[k]`` stays on the grid, ends in a free cell and cuts no
    corner; ``following[z, cell]`` is the state after entering a cell from ``z``, negative where that is not allowed.
    """

    shape: tuple[int, int]
    moves: UInt8[np.ndarray, " cells"]
    offsets: Int32[np.ndarray, "8"]
    following: Int32[np.ndarray, "Z cells"]
    keys: Float32[np.ndarray, " capacity"]
    nodes: Int32[np.ndarray, " capacity"]

    @classmethod
    def build(cls, transitions: Int32[np.ndarray, "H W Z"], free: Bool[np.ndarray, "H W"]) -> "ProductGrid":
        height, width, states = transitions.shape
        offsets = np.array([row * width + column for row, column in NEIGHBOURS], np.int32)
        following = np.ascontiguousarray(np.moveaxis(transitions, -1, 0)).reshape(states, -1).astype(np.int32)
        # A node enters a queue at most once from each neighbour; pages that are never used cost nothing.
        capacity = 8 * height * width * states + 1
        return cls(
            shape=(height, width),
            moves=_moves(free).reshape(-1),
            offsets=offsets,
            following=following,
            keys=np.empty(capacity, np.float32),
            nodes=np.empty(capacity, np.int32),
        )

    def heap_distances(self, cell: tuple[int, int], state: int) -> Float32[np.ndarray, "Z H W"]:
        """Costs in cells from a product state by Dijkstra with a binary heap."""
        return self._solve(_heap, cell, state)

    def bucket_distances(self, cell: tuple[int, int], state: int) -> Float32[np.ndarray, "Z H W"]:
        """Costs in cells from a product state by Dijkstra with buckets one cell wide."""
        return self._solve(_buckets, cell, state)

    def _solve(self, kernel, cell: tuple[int, int], state: int) -> Float32[np.ndarray, "Z H W"]:
        costs = np.full(self.following.size, np.inf, np.float32)
        source = state * self.moves.size + cell[0] * self.shape[1] + cell[1]
        kernel(self.moves, self.offsets, _STEPS, self.following, source, costs, self.keys, self.nodes)
        return costs.reshape(-1, *self.shape)


def _moves(free: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    height, width = free.shape
    padded = np.pad(free, 1)
    bits = np.zeros(free.shape, np.uint8)
    for index, (row, column) in enumerate(NEIGHBOURS):
        beside = (
            padded[1 + row : 1 + row + height, 1 : 1 + width] & padded[1 : 1 + height, 1 + column : 1 + column + width]
        )
        there = padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]
        allowed = there if 0 in (row, column) else there & beside
        bits |= (allowed.astype(np.uint8) << index).astype(np.uint8)
    return bits


# Both kernels write the loop over moves out. As a function of its own, inlined by numba or by LLVM, it makes the heap 3
# and the buckets 7 times slower (128 x 128 cells, 4 states): opponents are to be as fast as they can.
@numba.njit(cache=True)
def _heap(moves, offsets, steps, following, source, costs, keys, nodes):
    cells = moves.size
    keys[0], nodes[0], size = np.float32(0), source, 1
    costs[source] = 0
    while size > 0:
        cost, node = keys[0], nodes[0]
        size -= 1
        last_key, last_node = keys[size], nodes[size]
        hole, child = 0, 1
        while child < size:
            if child + 1 < size and keys[child + 1] < keys[child]:
                child += 1
            if keys[child] >= last_key:
                break
            keys[hole], nodes[hole] = keys[child], nodes[child]
            hole, child = child, 2 * child + 1
        keys[hole], nodes[hole] = last_key, last_node
        if cost > costs[node]:
            continue
        state = node // cells
        cell = node - state * cells
        mask = moves[cell]
        for k in range(8):
            if not (mask >> k) & 1:
                continue
            target = cell + offsets[k]
            next_state = following[state, target]
            if next_state < 0:
                continue
            next_node = next_state * cells + target
            next_cost = cost + steps[k]
            if next_cost < costs[next_node]:
                costs[next_node] = next_cost
                hole = size
                size += 1
                while hole > 0:
                    parent = (hole - 1) >> 1
                    if keys[parent] <= next_cost:
                        break
                    keys[hole], nodes[hole] = keys[parent], nodes[parent]
                    hole = parent
                keys[hole], nodes[hole] = next_cost, next_node


@numba.njit(cache=True)
def _buckets(moves, offsets, steps, following, source, costs, keys, nodes):
    # A bucket holds the costs in [b, b + 1). Every move costs at least 1, so that those within a bucket cannot improve
    # each other, and at most √2, so that three stacks are enough. A third of the memory each.
    cells = moves.size
    stride = nodes.size // 3
    sizes = np.zeros(3, np.int64)
    nodes[0], keys[0], sizes[0] = source, np.float32(0), 1
    costs[source] = 0
    current = 0
    while sizes[0] + sizes[1] + sizes[2] > 0:
        base = current * stride
        while sizes[current] > 0:
            sizes[current] -= 1
            slot = base + sizes[current]
            node, cost = nodes[slot], keys[slot]
            if cost > costs[node]:
                continue
            state = node // cells
            cell = node - state * cells
            mask = moves[cell]
            for k in range(8):
                if not (mask >> k) & 1:
                    continue
                target = cell + offsets[k]
                next_state = following[state, target]
                if next_state < 0:
                    continue
                next_node = next_state * cells + target
                next_cost = cost + steps[k]
                if next_cost < costs[next_node]:
                    costs[next_node] = next_cost
                    bucket = int(next_cost) % 3
                    slot = bucket * stride + sizes[bucket]
                    nodes[slot], keys[slot] = next_node, next_cost
                    sizes[bucket] += 1
        current = (current + 1) % 3

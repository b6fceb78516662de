"""Which grids and lumped bodies patches join: rows of cells, nodes of one temperature, and the sides of patches between them.

A patch joins a link with an object. An object of one temperature is a node of its own, whose heat capacity is the object's. One
that is divided into cells, and one that is a link of the same sensor, is a row of cells like a link: such a patch is a node of
no heat capacity, at the temperature of the interface, with a side on each row.

Shapes: `body` bodies that carry the sensor, `object` objects, `row` rows of cells: bodies, then objects with cells; `slot`
sides of a row, padded; `node` nodes: objects of one temperature, then interfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Topology:
    """What is joined.

    Attributes:
        num_bodies: Number of bodies.
        cells: How many cells each object has along each axis; all 1 if it has one temperature.
        grids: The objects that are rows of their own.
        lumped: The objects that are nodes.
        links: For each object the body that it is, if it is a link of the sensor; else −1.
        met: The (body, object) pairs that may meet.
    """

    num_bodies: int
    cells: tuple[tuple[int, int, int], ...]
    grids: tuple[int, ...]
    lumped: tuple[int, ...]
    links: tuple[int, ...]
    met: tuple[tuple[int, int], ...]

    @property
    def num_objects(self) -> int:
        """Number of objects."""
        return len(self.cells)

    @property
    def is_plain(self) -> bool:
        """Whether every object is a node: then a link's sides are its patches with the objects, in their order."""
        return len(self.lumped) == self.num_objects

    @property
    def num_rows(self) -> int:
        """Number of rows of cells."""
        return self.num_bodies + len(self.grids)

    @property
    def interfaces(self) -> tuple[tuple[int, int], ...]:
        """The pairs whose patch is a node of its own."""
        return tuple(pair for pair in self.met if pair[1] not in self.lumped)

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return len(self.lumped) + len(self.interfaces)

    def node_of(self, body: int, target: int) -> int:
        """Return the node of a pair's patch."""
        if target in self.lumped:
            return self.lumped.index(target)
        return len(self.lumped) + self.interfaces.index((body, target))

    def sides(self) -> list[list[tuple[int, bool, int]]]:
        """Return of each row its sides: the pair, counted body by body, whether it is the object's side, and the node."""
        rows: list[list[tuple[int, bool, int]]] = [[] for _ in range(self.num_rows)]
        for body, target in self.met:
            pair, node = body * self.num_objects + target, self.node_of(body, target)
            rows[body].append((pair, False, node))
            if self.links[target] >= 0:
                rows[self.links[target]].append((pair, True, node))
            elif target in self.grids:
                rows[self.num_bodies + self.grids.index(target)].append((pair, True, node))
        return rows

    def tables(self) -> dict[str, np.ndarray]:
        """Return the sides as arrays of indices.

        pair (row, slot), with the number of pairs where there is no side; is_object (row, slot); node (row, slot), 0 where
        there is none; at_node (node, share), sides counted row by row, with their number where there is none; coupled (node,
        node, share), pairs of slots counted row by row, with their number where there is none.
        """
        rows = self.sides()
        count = max([len(row) for row in rows] + [1])
        no_pair = self.num_bodies * self.num_objects
        pair = np.full((self.num_rows, count), no_pair, dtype=np.int64)
        is_object, node = np.zeros(pair.shape, dtype=np.int64), np.zeros(pair.shape, dtype=np.int64)
        at: list[list[int]] = [[] for _ in range(self.num_nodes)]
        coupled: dict[tuple[int, int], list[int]] = {}
        for r, row in enumerate(rows):
            for s, (own, is_objects, n) in enumerate(row):
                pair[r, s], is_object[r, s], node[r, s] = own, is_objects, n
                at[n].append(r * count + s)
                for t, (_, _, m) in enumerate(row):
                    if m != n:
                        coupled.setdefault((n, m), []).append((r * count + s) * count + t)
        shares = max([len(own) for own in at] + [1])
        at_node = np.full((self.num_nodes, shares), pair.size, dtype=np.int64)
        for n, own in enumerate(at):
            at_node[n, : len(own)] = own
        shares = max([len(own) for own in coupled.values()] + [0])
        between = np.full((self.num_nodes, self.num_nodes, shares), pair.size * count, dtype=np.int64)
        for (n, m), own in coupled.items():
            between[n, m, : len(own)] = own
        return {"pair": pair, "is_object": is_object, "node": node, "at_node": at_node, "coupled": between}

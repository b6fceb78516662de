"""Mirror a robot's hand: from the right hand's MJCF file, meshes and layout to those of the left.

The same joint values put both hands into mirrored poses, and taxel i of the left hand is the mirror image of taxel i of the
right one. Only signs change: numbers keep their digits, and what may hold geometry and is not known here is refused by name.

Run `python robots/mirror.py robots/xhand1/xhand1_right.xml --layout robots/xhand1/layout.yaml` to write the left XHand1 again
(the same bytes every time).
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mirror_mjcf import ModelMirror
from reflection import Mirror, MirrorError, flipped
from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from tgdsl.errors import TgdslError
from tgdsl.placement.sample.sample import point_table
from tgdsl.schema import yaml
from tgdsl.schema.placement import Grid, LayoutSpec, Points, Poisson
from tgdsl.surfaces.rays import reference_axes

_VECTORS = ["direction", "columns_along", "pos", "normal", "tangent", "center", "facing"]
_NOT_GEOMETRY = [
    *(
        "method",
        "rows",
        "columns",
        "count",
        "spacing",
        "seed",
        "radius",
        "area",
        "within",
        "surface",
        "exposed",
        "row",
        "column",
    ),
]


@dataclass
class Edits:
    """Replacements in a text, by place; a place that is reached twice, through an alias, is replaced once."""

    text: str
    found: dict[tuple[int, int], str] = field(default_factory=dict)

    def replace(self, node: Node, new: str) -> None:
        """Replace the text of a node."""
        self._note(node.start_mark.index, node.end_mark.index, new)

    def insert(self, node: Node, new: str) -> None:
        """Insert a text before a node."""
        self._note(node.start_mark.index, node.start_mark.index, new)

    def of(self, node: Node) -> str:
        """Return the text of a node."""
        return self.text[node.start_mark.index : node.end_mark.index]

    def result(self) -> str:
        """Return the text with all replacements made."""
        text = self.text
        for (start, end), new in sorted(self.found.items(), reverse=True):
            text = text[:start] + new + text[end:]
        return text

    def _note(self, start: int, end: int, new: str) -> None:
        if self.found.setdefault((start, end), new) != new:
            line = self.text.count("\n", 0, start) + 1
            raise MirrorError(f"line {line}: what an alias stands for would have to be mirrored in two ways; write it out")


@dataclass(eq=False)
class LayoutMirror:
    """Mirrors one layout file.

    Attributes:
        file: The file.
        mirror: The reflection.
        text: Its text.
        spec: What it means.
        outputs: Content of the files of points that were met, by path.
    """

    file: Path
    mirror: Mirror
    text: str
    spec: LayoutSpec
    outputs: dict[Path, bytes] = field(default_factory=dict)

    @staticmethod
    def of(file: Path, mirror: Mirror) -> LayoutMirror:
        """Read a layout file."""
        text = file.read_text(encoding="utf-8")
        return LayoutMirror(file, mirror, text, LayoutSpec.model_validate(yaml.parse(text, str(file)).value))

    def run(self) -> dict[Path, bytes]:
        """Return the content of every file of the mirrored layout, by path.

        Raises:
            MirrorError: If the layout holds what is not known here.
        """
        edits = Edits(self.text)
        for key, value in _items(YAML().compose(self.text)):
            if key.value == "groups":
                self._rename(edits, value)
            elif key.value == "resolutions":
                self._resolutions(edits, value)
            elif key.value != "tgdsl":
                raise MirrorError(f'{self.file}: "{key.value}" is not known to robots/mirror.py')
        head, body = _split_head(edits.result())
        target = self.file.with_name(self.mirror.file(self.file.name))
        self.outputs[target] = (head + self._header() + body).encode()
        return self.outputs

    def notes(self) -> list[str]:
        """Return what the layout cannot say of the mirrored hand."""
        found = []
        for resolution, links in self.spec.resolutions.items():
            for link, placement in links.items():
                if isinstance(placement, Poisson):
                    found.append(f"{resolution}, {link}: poisson samples of the same surface, not the mirror images")
                elif isinstance(placement, Points):
                    table = point_table(placement, self.file.parent, link)
                    normals = table.normal[np.isnan(table.tangent).any(axis=1)]  # those that follow the link's axes
                    num = sum(_default_columns(normal) == self.mirror.axis for normal in normals)
                    what = f"{resolution}, {link}: tangents follow the link's axes, {num} of {len(normals)} are the opposite"
                    found += [f"{what} of the mirror images"] if num else []
        return found

    def _header(self) -> str:
        axis, side = "xyz"[self.mirror.axis], self.mirror.source
        return (
            f"# Generated by robots/mirror.py from {self.file.name}: the {side} hand mirrored along {axis}. Change that file"
            f" and run the script again.\n# In each grid and list of points, taxel i is the mirror image of the {side} hand's"
            " taxel i.\n"
        )

    def _resolutions(self, edits: Edits, node: Node) -> None:
        for resolution, links in _items(node):
            for link, placement in _items(links):
                self._rename(edits, link)
                spec = self.spec.resolutions[resolution.value][link.value]
                if isinstance(spec, Grid):
                    self._reverse_rows(edits, placement, spec)
                self._placement(edits, placement)

    def _reverse_rows(self, edits: Edits, node: Node, grid: Grid) -> None:
        """Turn a grid's rows around: the mirror image of columns, rows and direction, a right-handed frame, is left-handed."""
        nodes = {key.value: (key, value) for key, value in _items(node)}
        wanted = {"rows_reversed": "false" if grid.rows_reversed else "true"}
        if grid.columns_along is None and _default_columns(grid.direction) == self.mirror.axis:
            wanted["columns_along"] = str([-int(i == self.mirror.axis) for i in range(3)])
        for key in nodes.keys() & wanted.keys():
            edits.replace(nodes[key][1], wanted.pop(key))
        before, _ = nodes.get("region", nodes["direction"])
        end = ", " if getattr(node, "flow_style", False) else "\n" + " " * before.start_mark.column
        edits.insert(before, "".join(f"{key}: {text}{end}" for key, text in wanted.items()))

    def _placement(self, edits: Edits, node: Node) -> None:
        """Mirror what placements and regions hold; `_reverse_rows` deals with the order of a grid's cells."""
        for key, value in _items(node):
            if key.value in _VECTORS and isinstance(value, SequenceNode):
                number = value.value[self.mirror.axis]
                edits.replace(number, flipped(edits.of(number)))
            elif key.value == "box":
                self._box(edits, value)
            elif key.value == "geoms":
                self._rename(edits, value)
            elif key.value == "points" and isinstance(value, ScalarNode):
                edits.replace(value, self._points_file(value.value))
            elif key.value in ("region", "points", "sphere"):
                for part in value.value if isinstance(value, SequenceNode) else [value]:
                    self._placement(edits, part)
            elif key.value not in ("rows_reversed", "columns_along", *_NOT_GEOMETRY):
                raise MirrorError(f'{self.file}: "{key.value}" is not known to robots/mirror.py: it may hold geometry')

    def _rename(self, edits: Edits, node: Node) -> None:
        for scalar in _scalars(node):
            edits.replace(scalar, self.mirror.renamed(edits.of(scalar)))

    def _box(self, edits: Edits, node: Node) -> None:
        low, high = ({key.value: value for key, value in _items(node)}[name] for name in ("min", "max"))
        one, other = low.value[self.mirror.axis], high.value[self.mirror.axis]
        edits.replace(one, flipped(edits.of(other)))
        edits.replace(other, flipped(edits.of(one)))

    def _points_file(self, name: str) -> str:
        """Return the name of the mirrored file of points, and note its content."""
        target = self.mirror.file(name)
        rows = list(csv.reader((self.file.parent / name).read_text(encoding="utf-8-sig").splitlines(), skipinitialspace=True))
        turned = {"xyz"[self.mirror.axis], "n" + "xyz"[self.mirror.axis]}
        flips = [column.strip() in turned for column in rows[0]]
        lines = [rows[0]] + [
            [flipped(t.strip()) if f else t for t, f in zip(row, flips, strict=True)] for row in rows[1:] if row
        ]
        self.outputs[self.file.parent / target] = "".join(",".join(line) + "\n" for line in lines).encode()
        return target


def _default_columns(direction: Iterable[float]) -> int:
    """Return which of the link's axes orients what is perpendicular to a direction, where the layout does not say."""
    unit = np.array(tuple(direction), dtype=np.float64)
    unit /= np.abs(unit).max()  # the square of a tiny or huge one is not representable
    return int(reference_axes(unit[None] / np.linalg.norm(unit))[0].argmax())


def _items(node: Node) -> list[tuple[Node, Node]]:
    """Return keys and values of a mapping."""
    if not isinstance(node, MappingNode):
        raise MirrorError(f"line {node.start_mark.line + 1}: expected a mapping")
    return node.value


def _scalars(node: Node) -> Iterator[ScalarNode]:
    """Yield the values in a node, at any depth."""
    if isinstance(node, ScalarNode):
        yield node
    else:
        for child in node.value:
            yield from _scalars(child[1] if isinstance(child, tuple) else child)


def _split_head(text: str) -> tuple[str, str]:
    """Return the editor's line at the top, and what follows the comments at the top."""
    lines = text.splitlines(keepends=True)
    num = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    head = "".join(line for line in lines[:num] if "yaml-language-server" in line)
    return head, "".join(lines[num:])


def mirrored_files(model: Path, layout: Path | None, mirror: Mirror) -> tuple[dict[Path, bytes], list[str]]:
    """Return the content of all files of the mirrored hand, by path, and notes on what differs.

    Args:
        model: The hand's MJCF file.
        layout: Its layout, or None.
        mirror: The reflection.

    Raises:
        MirrorError: If a file holds what is not known here.
    """
    outputs = ModelMirror(model, mirror).run()
    if layout is None:
        return outputs, []
    placements = LayoutMirror.of(layout, mirror)
    return outputs | placements.run(), placements.notes()


def main() -> None:
    """Write the mirrored hand's files beside the hand's own."""
    parser = argparse.ArgumentParser(description="Mirror a hand's model, meshes and layout.")
    parser.add_argument("model", type=Path, help="the hand's MJCF file")
    parser.add_argument("--layout", type=Path, help="its layout")
    parser.add_argument("--axis", choices="xyz", default="y", help="the axis of the model's frame that is turned around")
    parser.add_argument("--source", default="right", help="the side in the names of what is read")
    parser.add_argument("--target", default="left", help="the side that it becomes")
    arguments = parser.parse_args()
    mirror = Mirror("xyz".index(arguments.axis), arguments.source, arguments.target)
    try:
        outputs, notes = mirrored_files(arguments.model, arguments.layout, mirror)
    except (TgdslError, OSError) as error:
        raise SystemExit(str(error)) from error
    for path, content in outputs.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        print(path)
    for note in notes:
        print(f"note: {note}")


if __name__ == "__main__":
    main()

"""A page where a proposed layout is changed before it is written: density, side and region of links, and their groups."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from tgdsl.errors import TgdslError
from tgdsl.placement.propose.propose import FACTORS, Draft, LinkProposal
from tgdsl.placement.propose.text import check_new, write_layout
from tgdsl.placement.sample.sample import Samples
from tgdsl.view.cameras import pose_of
from tgdsl.view.layers import add_discs
from tgdsl.view.live_scene import add_body, aim_camera
from tgdsl.view.markers import Markers, in_world
from tgdsl.view.page import FRAME, PORT, serve, stop, url_of
from tgdsl.view.panel import EVERY
from tgdsl.view.style import LIVE_OTHER, LIVE_REST, LIVE_SENSING

CHOSEN = (234, 88, 12)  # colour of the taxels of the chosen links
AXIS_LENGTH = 0.02  # of the axes at the origin of the chosen link [m]
ALL_AROUND = "all around"
_SIDES = {f"{'-+'[sign > 0]}{'xyz'[i]}": tuple(sign * float(i == k) for k in range(3)) for i in range(3) for sign in (1, -1)}


class LayoutPage:
    """A page that shows the taxels of a draft, and whose controls change it.

    Args:
        draft: The layout.
        out: The file that the button writes.
        is_forced: Whether that may replace a file that the page did not write.
        port: Port; if it is in use, the next free one.

    Attributes:
        written: Lines that sum up the last file that was written; empty before the first.
    """

    def __init__(self, draft: Draft, out: Path, is_forced: bool = False, port: int = PORT):
        self.draft, self.out, self.is_forced = draft, out, is_forced
        self.written: list[str] = []
        self.server, self._clicks = serve(port=port), SimpleQueue[Callable[[], None]]()
        self._model, self._discs = draft.robot.compiled, dict[str, Any]()
        self._sampled: dict[str, tuple[Any, Samples]] = {}  # by link: its placement, and the taxels
        self._bytes: bytes | None = None  # of the file that the page wrote
        self._add_controls()
        self._offer()
        self._sample()
        self._add_scene()
        self._draw()

    @property
    def url(self) -> str:
        """The page's address."""
        return url_of(self.server)

    def close(self) -> None:
        """Stop serving."""
        stop(self.server)

    def run(self, seconds: float = math.inf) -> None:
        """Follow the controls, for some seconds or until interrupted."""
        begin = time.monotonic()
        while time.monotonic() - begin < seconds:
            self.react()
            time.sleep(FRAME)

    def react(self) -> None:
        """Apply the clicks and settings since the last call."""
        while not self._clicks.empty():
            self._clicks.get()()
        if (self.chosen.value, self.resolution.value) != self._shown:
            self._offer()
            self._try(lambda: None)
        values = self._values()
        if values != self._tried:
            self._tried = values
            new = {name: value for name, value in values.items() if value != self._applied[name]}
            if self._try(lambda: self.draft.change([link.name for link in self._links()], **new)):
                self._applied = values
        for group, boxes in self.members.items():
            links = {name for name, box in boxes.items() if box.value}
            if links != set(self.draft.proposal.members[group]):
                self.draft.set_group(group, links)
                self._offer()
                self._draw()

    # Controls --------------------------------------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui, proposal = self.server.gui, self.draft.proposal
        self.problem, self.status = gui.add_markdown(""), gui.add_markdown("")
        self.resolution = gui.add_dropdown("resolution", tuple(FACTORS), initial_value="med")
        groups = (f"({group})" for group in proposal.members)
        self.chosen = gui.add_dropdown("links", tuple(dict.fromkeys((EVERY, *groups, *(link.name for link in proposal.links)))))
        self._folder, self._offered = gui.add_folder("taxels"), list[Any]()
        self.members: dict[str, dict[str, Any]] = {}
        for group, members in proposal.members.items():
            with gui.add_folder(f"group {group}", expand_by_default=False):
                self.members[group] = {link.name: gui.add_checkbox(link.name, link.name in members) for link in proposal.links}
        gui.add_button(f"write {self.out.name}").on_click(lambda _: self._clicks.put(self._write))

    def _links(self) -> list[LinkProposal]:
        """Return the chosen links; a group without links chooses none."""
        proposal, choice = self.draft.proposal, self.chosen.value
        names = {f"({group})": members for group, members in proposal.members.items()}.get(choice, (choice,))
        return [link for link in proposal.links if choice == EVERY or link.name in names]

    def _offer(self) -> None:
        """Offer controls for the chosen links, set to the values of the first one."""
        gui, links = self.server.gui, self._links()
        self._shown = self.chosen.value, self.resolution.value
        for handle in self._offered:
            handle.remove()
        self._offered, self._applied, self._tried = [], {}, {}
        self._bounds: list[tuple[Any, float, float]] = []
        if not links:
            return
        first = links[0]
        self._sides = {ALL_AROUND: None, **_SIDES}
        if first.facing not in self._sides.values():
            self._sides[f"{[float(f'{x:g}') for x in first.facing or ()]}"] = first.facing
        side = next(name for name, facing in self._sides.items() if facing == first.facing)
        with self._folder:
            self.density = gui.add_number("taxels per cm²", first.density * 1e-4, step=0.01)
            self.side = gui.add_dropdown("side", tuple(self._sides), initial_value=side)
            self.within = gui.add_number("within [deg]", float(first.within), step=1.0)
            if len(links) == 1:
                low, high = self.draft.bounds(first.name)
                now = first.box or (low, high)
                for axis, ends in zip("xyz", zip(low, high, *now, strict=True), strict=True):
                    least, most, *inner = (round(1e3 * end, 1) for end in ends)
                    value = tuple(float(np.clip(end, least, most)) for end in inner)
                    slider = gui.add_multi_slider(f"{axis} [mm]", least, most, 0.1, value, min_range=0.1)
                    self._bounds.append((slider, least, most))
        self._offered = [self.density, self.side, self.within, *(slider for slider, _, _ in self._bounds)]
        self._applied = self._tried = self._values()

    def _values(self) -> dict[str, Any]:
        """Return the values of the controls, as arguments of `Draft.change`."""
        if not self._offered:
            return {}
        values = {"density": self.density.value * 1e4, "facing": self._sides[self.side.value], "within": self.within.value}
        if not self._bounds:
            return values
        is_whole = all(tuple(slider.value) == (least, most) for slider, least, most in self._bounds)
        corners = zip(*(slider.value for slider, _, _ in self._bounds), strict=True)
        box = tuple(tuple(round(1e-3 * end, 4) for end in corner) for corner in corners)
        return {**values, "box": None if is_whole else box}

    def _try(self, change: Callable[[], None]) -> bool:
        """Change the draft and draw it; where that fails, show the error, restore the draft and return False."""
        previous = self.draft.proposal
        try:
            change()
            self._sample()
        except TgdslError as error:
            self.draft.proposal = previous
            self.problem.content = f"```\n{error}\n```"
            return False
        self.problem.content = ""
        self._draw()
        return True

    def _write(self) -> None:
        """Write the layout, unless the controls have a value that failed."""
        if self._tried != self._applied:
            self.problem.content += "\n\nnothing is written"
            return
        try:
            is_own = self.out.is_file() and self.out.read_bytes() == self._bytes
            check_new(self.out, self.is_forced or is_own)
            self.written = write_layout(self.draft, self.out)
            self._bytes = self.out.read_bytes()
            self.problem.content = f"{self.out}: written"
        except TgdslError as error:
            self.problem.content = f"```\n{error}\n```"

    # Scene -----------------------------------------------------------------------------------------------------------------

    def _sample(self) -> None:
        """Place the taxels of links that have changed."""
        resolution = self.resolution.value
        for link in self.draft.proposal.links:
            key = self.draft.proposal.placement(link, resolution)
            if link.name not in self._sampled or self._sampled[link.name][0] != key:
                self._sampled[link.name] = key, self.draft.samples(link, resolution)

    def _add_scene(self) -> None:
        scene, pose = self.server.scene, pose_of(self._model, None)
        self._frames = {}
        for body in range(self._model.nbody):
            name = self._model.body(body).name
            place = {"position": pose.pos[body], "wxyz": pose.quat[body]}
            self._frames[name] = scene.add_frame(
                f"/body{body}", show_axes=False, axes_length=AXIS_LENGTH, axes_radius=0.03 * AXIS_LENGTH, **place
            )
            for mesh, _ in add_body(scene, self._model, body, (), LIVE_SENSING if name in self._sampled else LIVE_OTHER, True):
                if name in self._sampled:
                    mesh.on_click(lambda _, name=name: self._clicks.put(lambda: self._choose(name)))
        parts = [samples for _, samples in self._sampled.values()]
        pos, normal, area = (np.concatenate([getattr(part, name) for part in parts]) for name in ("pos", "normal", "area"))
        bodies = [name for name, (_, samples) in self._sampled.items() for _ in samples.pos]
        pos, normal = in_world(self._model, pose, bodies, pos, normal)
        origin = pose.pos[min(self._model.body(name).id for name in self._sampled)]
        aim_camera(self.server, Markers(pos, normal, np.sqrt(area), np.zeros(len(pos)), "", ""), origin)

    def _choose(self, name: str) -> None:
        """Choose a link; a second click on it chooses all again."""
        self.chosen.value = EVERY if self.chosen.value == name else name

    def _draw(self) -> None:
        """Draw changed taxels, with the chosen links in another colour, and count them."""
        selected, resolution, links = self._links(), self.resolution.value, self.draft.proposal.links
        names = {link.name for link in selected} if self.chosen.value != EVERY else set()
        with self.server.atomic():
            for name, (key, samples) in self._sampled.items():
                state = key, name in names
                if name not in self._discs or self._discs[name][0] != state:
                    if name in self._discs:
                        self._discs[name][1].remove()
                    path, size = f"/body{self._model.body(name).id}/taxels", np.sqrt(samples.area)
                    colour = CHOSEN if name in names else LIVE_REST
                    handle = add_discs(self.server.scene, path, samples.pos, samples.normal, size, colour=colour)
                    handle.on_click(lambda _, name=name: self._clicks.put(lambda: self._choose(name)))
                    self._discs[name] = state, handle
                self._frames[name].show_axes = names == {name}
            total, part = (sum(link.counts[resolution] for link in some) for some in (links, selected))
            area = 1e4 * sum(link.area for link in selected)
            self.status.content = f"{total} taxels at {resolution}, {part} of them on the chosen {area:.3g} cm²"

"""The controls of the live page. The page reads what they are set to before each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_hex

from tgdsl.module.outputs import Output
from tgdsl.view.layers import Shown
from tgdsl.view.stages import Stage

Array = np.ndarray
EVERY = "(all)"  # of links: no choice; a group may be named "all"
PARTS = ("robot", "objects", "taxels", "arrows", "contacts", "heat maps")
_BLANK = np.full((8, 8, 3), 255, dtype=np.uint8)


class Panel:
    """The handles of a page's controls."""

    def __init__(self, gui: Any, stage: Stage, outputs: Mapping[str, Output], sounds: Sequence[str], reading: str | None):
        import viser.uplot as uplot

        names, groups = list(outputs), stage.touch.plan.layout.groups
        reading = reading if reading in names else names[0]
        self.problem, self.status = gui.add_markdown(""), gui.add_markdown("")
        self.env = gui.add_slider("environment", 0, stage.num_envs - 1, 1, 0) if stage.num_envs > 1 else None
        self.instant = gui.add_slider("step", 0, max(1, stage.num_steps - 1), 1, 0) if stage.num_steps else None
        self.paused = gui.add_checkbox("pause", False)
        self.speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        self.time = gui.add_button_group("time", ("step once", "restart"))
        with gui.add_folder("touch"):
            self.reading = gui.add_dropdown("reading", names, initial_value=reading)
            self.channel = gui.add_dropdown("channel", ("",))
            self.legend = gui.add_html("")
            self.value = gui.add_markdown("")
            self.plotted = gui.add_dropdown("plot", (EVERY,))
            series = (uplot.Series(label="t [s]"), uplot.Series(label="reading", stroke="#c2410c", width=2))
            data = (np.array([0.0, 1.0]), np.array([0.0, 0.0]))
            self.plot = gui.add_uplot(data, series, scales={"x": uplot.Scale(time=False)}, aspect=2.0)
            self.maps = gui.add_image(_BLANK, label="heat maps, distal ends up", jpeg_quality=90, visible=False)
        self.sound = self.spectrogram = None
        if sounds:
            with gui.add_folder("sound"):
                self.sound = gui.add_dropdown("sensor", sounds)
                self.spectrogram = gui.add_image(_BLANK, label="spectrogram", jpeg_quality=90)
        self.notes = gui.add_markdown("")
        self.group_values = self.observed = None
        if stage.groups:
            with gui.add_folder("observations", expand_by_default=stage.by_hand is not None):
                self.observed = gui.add_dropdown("group", stage.groups)
                self.group_values = gui.add_markdown("")
        with gui.add_folder("show", expand_by_default=False):
            self.parts = {name: gui.add_checkbox(name, True) for name in PARTS}
            self.is_plain = gui.add_checkbox("robot in grey", True)
            self.also = {name: gui.add_checkbox(f"also {name}", False) for name in names} if len(names) > 1 else {}
            self.group = gui.add_dropdown("links of", (EVERY, *groups))
            links = dict.fromkeys(link.name for sensor in stage.touch.plan.sensors for link in sensor.links)
            self.links = {name: gui.add_checkbox(name, True) for name in links}
        self.sliders: list[Any] = []
        with gui.add_folder("save"):
            self.screenshot, self.record = gui.add_button("screenshot"), gui.add_button("video")
            self.save = gui.add_button("save last minute")
        self.by_hand = self.keyframe = None
        if stage.control is None or not len(stage.control):
            return
        with gui.add_folder("actuators" if stage.by_hand is None else "actions"):
            if stage.by_hand is None:
                keys = (stage.model.key(i).name for i in range(stage.model.nkey))
                self.keyframe = gui.add_dropdown("keyframe", ("", *filter(None, keys)))
            else:
                self.by_hand = gui.add_checkbox("by hand", False)
            self.sliders += (gui.add_slider(name, low, high, (high - low) / 200, low) for name, low, high in stage.sliders)
        self.set_sliders(stage.control)

    @property
    def env_index(self) -> int:
        """The environment that is chosen."""
        return 0 if self.env is None else int(self.env.value)

    @property
    def readings(self) -> list[str]:
        """The readings to draw; the chosen one is first."""
        return [self.reading.value, *(name for name, box in self.also.items() if box.value and name != self.reading.value)]

    @property
    def shown_links(self) -> set[str]:
        """The links that are switched on."""
        return {name for name, box in self.links.items() if box.value}

    def set_sliders(self, control: Float[Array, " actuator"]) -> None:
        """Set the sliders to controls, or as near as their ranges allow."""
        for slider, value in zip(self.sliders, control, strict=True):
            slider.value = float(np.clip(value, slider.min, slider.max))


def legend(shown: Shown) -> str:
    """Return the bar of a reading's colours as HTML."""
    low, high = float(shown.norm.vmin or 0.0), float(shown.norm.vmax or 1.0)
    stops = ", ".join(to_hex(shown.colours(x)) for x in np.linspace(0, 1, 9))
    low_text = "0" if abs(low) < 1e-11 else f"{low:.3g}"
    return (
        f'<div style="padding:0 0.75em"><div>{shown.label}</div>'
        f'<div style="height:0.7em;background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{low_text}</span><span>{high:.3g}</span></div></div>'
    )

"""A live page in the browser: robot and objects, taxels coloured by what they read, and the controls of a scene.

The page is served by viser, an optional package: `pip install tgdsl[view]`.

Shapes: `taxel` rows of the chosen reading.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import BytesIO, StringIO
from queue import SimpleQueue
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import Colormap, Normalize, to_hex
from scipy.spatial.transform import Rotation

from tgdsl.errors import TgdslError
from tgdsl.module.outputs import Output
from tgdsl.view.boxes import boxes_of, is_boxed
from tgdsl.view.cameras import facing_camera
from tgdsl.view.markers import Markers, Pose, Taxels, markers_of, read_now, rows_of
from tgdsl.view.meshes import body_triangles, robot_bodies
from tgdsl.view.stages import Stage
from tgdsl.view.style import HEAT, WARMTH

Array = np.ndarray
LOCAL = "127.0.0.1"
PORT = 8080
NETWORK_WARNING = "the page is served at {}: whoever reaches this machine can see and control it"
FRAME = 1 / 30  # least time between two frames [s]
PLOT_SECONDS = 10.0  # how much of the past the plot shows [s]
SAVED_FRAMES = 1800  # number of frames that the page can save: the last minute at 30 per second
MAX_STEPS = 5  # most control steps per frame: a scene slower than that runs behind real time
_CARRIER, _ROBOT, _OBJECT, _REST = (176, 181, 190), (128, 134, 145), (60, 112, 186), (62, 72, 88)
_DISC_RADIUS = (0.0006, 0.0022)
_LIFT = 2e-4  # how far discs and arrows begin above the surface [m]
_ARROW = 0.03  # length of the arrow of the largest vector [m]
_HEAT = HEAT.with_extremes(under="#{:02x}{:02x}{:02x}".format(*_REST))
_SIGNED = matplotlib.colormaps["coolwarm"]
MAGNITUDE = "magnitude"


class Page:
    """A page that shows a stage, and whose controls act on it.

    Open it in any number of browsers; closing or reloading one changes nothing.

    Args:
        stage: The scene; see `show` for another.
        host: Address to serve at; any but the local one lets others in the network see and control the scene.
        port: Port; where it is taken, the next free one.
    """

    def __init__(self, stage: Stage, host: str = LOCAL, port: int = PORT):
        drawn(stage)
        check_viser()
        import viser

        with redirect_stdout(StringIO()):  # viser prints its address
            self.server = viser.ViserServer(host=host, port=port, label="tgdsl view", verbose=False)
        if host != LOCAL:
            warnings.warn(NETWORK_WARNING.format(host), stacklevel=2)
        self._clicks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.show(stage)

    @property
    def url(self) -> str:
        """The page's address."""
        host = self.server.get_host()
        return f"http://{'localhost' if host == LOCAL else host}:{self.server.get_port()}"

    def show(self, stage: Stage) -> None:
        """Show a stage in place of the one before; the camera stays.

        Raises:
            TgdslError: If the stage has nothing to draw; the one before stays.
        """
        self._outputs = drawn(stage)
        is_first = not hasattr(self, "stage")
        chosen = None if is_first else self._reading.value
        self.stage = stage
        self._picked: int | None = None
        self._range: dict[tuple[str, str], float] = {}
        self._history: deque[tuple[float, float]] = deque()
        self._frames_seen: deque[dict[str, Array]] = deque(maxlen=SAVED_FRAMES)
        with self.server.atomic():
            self.server.scene.reset()
            self.server.gui.reset()
            self.server.gui.configure_theme(show_share_button=False)  # viser's would open a tunnel to the internet
            self._discs: dict[int, Any] = {}
            self._add_bodies()
            self._add_controls(chosen)
            self._add_discs()
        self.draw()
        if is_first:
            self._place_camera()

    def run(self, watch: Callable[[], Stage | str | None] = lambda: None, seconds: float = math.inf) -> None:
        """Step the stage in real time and draw it, for some seconds or until interrupted.

        `watch` is asked before each frame for another stage to show, or for text of what is wrong with it; None: nothing new.
        """
        begin = before = time.monotonic()
        due = 0.0
        while time.monotonic() - begin < seconds:
            start = time.monotonic()
            change = watch()
            if isinstance(change, Stage):
                last = self.stage
                try:
                    self.show(change)
                    last.close()
                except TgdslError as error:
                    change.close()
                    change = str(error)
            if isinstance(change, str):
                self._problem.content = f"```\n{change}\n```"
            self._react()
            due = 0.0 if self._paused.value else due + self._speed.value * (start - before)
            before = start
            steps = min(MAX_STEPS, int(due / self.stage.control_step))
            due = min(due - steps * self.stage.control_step, self.stage.control_step)
            for _ in range(steps):
                self.stage.advance()
            self.draw()
            time.sleep(max(0.0, FRAME - (time.monotonic() - start)))

    def close(self) -> None:
        """Stop serving."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def draw(self) -> None:
        """Draw the stage as it is now."""
        env = self._env_index
        pos, quat = self.stage.body_poses(env)
        with self.server.atomic():
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = pos[body], quat[body]
            if self.stage.readings:
                self._draw_touch(env)
            self._draw_text()
        self._record(env, pos, quat)

    def saved_frames(self) -> bytes:
        """Return the frames drawn in the last minute as an `.npz` file.

        Its arrays are `time` (frame,) [s], `env` (frame,), `body_pos` (frame, body, 3) [m], `body_quat` (frame, body, 4) as
        w, x, y, z, both in the world, and each reading by its name, (frame, ...) as in `touch.outputs` without `env`.
        """
        file = BytesIO()
        arrays = {name: np.stack([frame[name] for frame in self._frames_seen]) for name in self._frames_seen[0]}
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    def _record(self, env: int, pos: Float[Array, "body 3"], quat: Float[Array, "body 4"]) -> None:
        """Keep a frame for `saved_frames`; an instant of one environment is kept once."""
        last = self._frames_seen[-1] if self._frames_seen else None
        if not self.stage.readings or (last is not None and (last["time"], last["env"]) == (self.stage.time, env)):
            return
        frame = {"time": np.array(self.stage.time), "env": np.array(env), "body_pos": pos.copy(), "body_quat": quat.copy()}
        readings = {o.name: self.stage.readings[o.name][env].detach().cpu().numpy().copy() for o in self._outputs.values()}
        self._frames_seen.append({**readings, **frame})

    # The scene -------------------------------------------------------------------------------------------------------------

    def _add_bodies(self) -> None:
        """Add a frame and a mesh for each body."""
        model, links = self.stage.model, self.stage.touch.plan.layout.links
        carriers = {model.body(link.body).id for link in links}
        carriers |= {model.body(name).id for output in self._outputs.values() for name in output.bodies}
        self._near, robot = robot_bodies(model, carriers)
        scene = self.server.scene
        scene.set_up_direction("+z")
        self._frames, self._meshes = {}, {"robot": [], "objects": []}
        for body in range(model.nbody):
            self._frames[body] = scene.add_frame(f"/body{body}", show_axes=False)
            corners, normals = body_triangles(model, body, links)
            if not len(corners):
                continue
            is_robot = body in robot or body == 0
            colour = _CARRIER if body in carriers else _ROBOT if is_robot else _OBJECT
            mesh = scene.add_mesh_simple(f"/body{body}/mesh", *_joined(corners, normals), color=colour)
            self._meshes["robot" if is_robot else "objects"].append(mesh)

    def _add_discs(self) -> None:
        """Add a disc for each row of the chosen reading, in the frame of its body."""
        for handle in self._discs.values():
            handle.remove()
        self._discs = {}
        self._is_boxed = is_boxed(self.stage.touch, self._output)
        self._table_now = table = self._table()
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        corners = np.vstack([[0, 0, 0], np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)])
        faces = np.array([[0, 1 + i, 1 + (i + 1) % 16] for i in range(16)])
        self._rows_of = {int(body): np.flatnonzero(table.body == body) for body in np.unique(table.body)}
        for body, rows in self._rows_of.items():
            normal = table.rows.normal[rows]
            turns = [Rotation.align_vectors(n[None], [[0, 0, 1]])[0].as_quat(scalar_first=True) for n in normal]
            self._discs[body] = self.server.scene.add_batched_meshes_simple(
                f"/body{body}/taxels",
                corners,
                faces,
                np.array(turns),
                table.rows.pos[rows] + _LIFT * normal,
                batched_scales=np.clip(0.45 * table.rows.size[rows], *_DISC_RADIUS),
                batched_colors=np.tile(np.array(_REST, dtype=np.uint8), (len(rows), 1)),
                side="double",
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._discs[body].on_click(
                lambda event, rows=rows: self._clicks.put(lambda: self._pick(int(rows[event.instance_index])))
            )

    def _table(self) -> _Table:
        """Return where the chosen reading's rows are in the frames of their bodies."""
        touch, output = self.stage.touch, self._output
        if self._is_boxed:
            layout = boxes_of(touch, output, torch.zeros(1, *output.shape), 0).layout
            names = [layout.links[i].body for i in layout.link_id]
            rows, labels = (
                Taxels(layout.pos, layout.normal, np.sqrt(layout.area)),
                [f"{n}, cell {i}" for i, n in enumerate(names)],
            )
        else:
            names, rows = rows_of(touch, output)
            links = touch.taxels[output.sensor]["link"]
            labels = names if output.rows == "body" else [f"{link}, taxel {i}" for i, link in enumerate(links)]
        if self._is_boxed or output.rows == "body":
            rows = Taxels(rows.pos, rows.normal / np.linalg.norm(rows.normal, axis=1, keepdims=True), rows.size)
        return _Table(np.array([self.stage.model.body(name).id for name in names]), rows, labels)

    def _place_camera(self) -> None:
        """Look at what carries taxels, from where most of these face."""
        pose, table = Pose(*self.stage.body_poses(0)), self._table_now
        turn = Rotation.from_quat(pose.quat[table.body], scalar_first=True)
        pos, normal = pose.pos[table.body] + turn.apply(table.rows.pos), turn.apply(table.rows.normal)
        camera = facing_camera(Markers(pos, normal, table.rows.size, np.zeros(len(pos)), "", ""), pose.pos[min(self._near)])
        centre = 0.5 * (pos.min(axis=0) + pos.max(axis=0))
        reach = max(0.03, float(np.linalg.norm(pos - centre, axis=1).max()))
        initial = self.server.initial_camera
        initial.position, initial.look_at, initial.up = centre + 2.4 * reach * camera.toward, centre, camera.up
        initial.near = 0.1 * reach

    # Touch -----------------------------------------------------------------------------------------------------------------

    @property
    def _output(self) -> Output:
        return self._outputs[self._reading.value]

    @property
    def _env_index(self) -> int:
        return int(self._env.value) if self._env is not None else 0

    def _draw_touch(self, env: int) -> None:
        """Colour the discs, and draw arrows, the legend and the plot."""
        output, channel = self._output, self._channel.value
        readings, markers = self.stage.readings[output.name], None
        if self._is_boxed:
            boxes = boxes_of(self.stage.touch, output, readings, env)
            value, unit, colours = boxes.value[boxes.chosen], boxes.unit, WARMTH
            norm, label = boxes.norm, boxes.label
        elif channel == MAGNITUDE:
            markers = markers_of(self.stage.touch, self.stage, output, readings, env)
            value, unit, colours = markers.value / markers.scale, _unit(output.units[0]), _HEAT
            norm, label = Normalize(1e-12, self._widened(output, channel, value), clip=False), f"{markers.quantity} [{unit}]"
        else:
            i = output.channels.index(channel)
            value, unit, colours = read_now(readings, env)[:, i], _unit(output.units[i]), _SIGNED
            most = self._widened(output, channel, value)
            norm, label = Normalize(-most, most, clip=True), f"{channel} [{unit}]"
        colour: UInt8[Array, "taxel 3"] = (255 * np.asarray(colours(norm(value)))[:, :3]).astype(np.uint8)
        for body, rows in self._rows_of.items():
            self._discs[body].batched_colors = colour[rows]
        self._draw_arrows(markers)
        self._legend.content = _legend(colours, norm, label)
        picked, total = self._picked, "mean" if self._is_boxed else "sum"
        shown = float(getattr(value, total)() if picked is None else value[picked])
        self._history.append((self.stage.time, shown))
        while not 0 <= self.stage.time - self._history[0][0] <= PLOT_SECONDS:
            self._history.popleft()
        name = total if picked is None else self._table_now.labels[picked]
        self._reads.content = f"**{name}**: {label.split(' [')[0]} {shown:.4g} {unit}"
        if len(self._history) > 1:
            times, values = np.array(self._history).T
            self._plot.data = (times, values)

    def _widened(self, output: Output, channel: str, value: Float[Array, " taxel"]) -> float:
        """Return the largest size that was read so far: the end of the colours."""
        key = (output.name, channel)
        most = float(np.abs(value[np.isfinite(value)]).max(initial=0.0))
        self._range[key] = max(self._range.get(key, 1e-9), most)
        return self._range[key]

    def _draw_arrows(self, markers: Markers | None) -> None:
        """Draw vectors from the taxels where the reading is a vector and arrows are asked for."""
        if self._arrow_handle is not None:
            self._arrow_handle.remove()
            self._arrow_handle = None
        if markers is None or markers.vector is None or not (self._arrows.value and markers.is_read.any()):
            return
        longest = self._range[self._output.name, MAGNITUDE]
        begin = markers.pos[markers.is_read] + _LIFT * markers.normal[markers.is_read]
        points = np.stack([begin, begin + _ARROW / longest * markers.vector[markers.is_read]], axis=1).astype(np.float32)
        style = {"thickness": 2.0, "thickness_units": "screen"}
        self._arrow_handle = self.server.scene.add_line_segments("/arrows", points, (30, 30, 30), **style)

    def _draw_text(self) -> None:
        """Write the time, and what the stage notes."""
        notes = self.stage.notes(self._env_index)
        rows = [f"\n| {name} | {f'{value:.4g}' if isinstance(value, float) else value} |" for name, value in notes.items()]
        self._notes.content = f"| | |\n|---|---|{''.join(rows)}" if rows else ""
        self._status.content = f"t = {self.stage.time:.2f} s · {len(self._table_now.body)} taxels"
        if self._instant is not None and self.stage.step_index != int(self._instant.value):
            self._instant.value = self._seen_instant = self.stage.step_index

    # Controls --------------------------------------------------------------------------------------------------------------

    def _add_controls(self, reading: str | None) -> None:
        """Add the page's panel; what it is set to is read before each frame."""
        import viser.uplot as uplot

        gui, stage = self.server.gui, self.stage
        self._problem = gui.add_markdown("")
        self._status = gui.add_markdown("")
        self._env = gui.add_slider("environment", 0, stage.num_envs - 1, 1, 0) if stage.num_envs > 1 else None
        self._instant = gui.add_slider("step", 0, max(1, (stage.num_steps or 2) - 1), 1, 0) if stage.num_steps else None
        self._seen_instant, self._seen_env = 0, 0
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        gui.add_button("step once").on_click(lambda _: self._clicks.put(self._step_once))
        gui.add_button("restart").on_click(lambda _: self._clicks.put(self._restart))
        gui.add_button("save last minute").on_click(lambda event: self._clicks.put(lambda: self._save(event.client)))
        with gui.add_folder("touch"):
            names = list(self._outputs)
            self._reading = gui.add_dropdown("reading", names, initial_value=reading if reading in names else names[0])
            self._seen_reading = self._reading.value
            self._channel = gui.add_dropdown("channel", self._channels())
            self._arrows = gui.add_checkbox("arrows", True)
            self._arrow_handle: Any = None
            self._legend = gui.add_html("")
            self._reads = gui.add_markdown("")
            series = (uplot.Series(label="t [s]"), uplot.Series(label="reading", stroke="#c2410c", width=2))
            data = (np.array([0.0, 1.0]), np.array([0.0, 0.0]))
            self._plot = gui.add_uplot(data, series, scales={"x": uplot.Scale(time=False)}, aspect=2.0)
        self._notes = gui.add_markdown("")
        with gui.add_folder("show", expand_by_default=False):
            self._shown = {name: gui.add_checkbox(name, True) for name in ("robot", "objects", "taxels")}
        self._sliders: list[Any] = []
        if stage.control is not None and len(stage.control):
            with gui.add_folder("actuators"):
                keys = (stage.model.key(i).name for i in range(stage.model.nkey))
                self._keyframe = gui.add_dropdown("keyframe", ("", *filter(None, keys)))
                self._seen_keyframe = self._keyframe.value
                for i, (low, high) in enumerate(stage.model.actuator_ctrlrange):
                    low, high = (float(low), float(high)) if stage.model.actuator_ctrllimited[i] else (-1.0, 1.0)
                    value = float(np.clip(stage.control[i], low, high))
                    name = stage.model.actuator(i).name or f"actuator {i}"
                    self._sliders.append(gui.add_slider(name, low, high, (high - low) / 200, value))

    def _channels(self) -> tuple[str, ...]:
        output = self._output
        return (output.channels[0],) if is_boxed(self.stage.touch, output) else (MAGNITUDE, *output.channels)

    def _react(self) -> None:
        """Do what was clicked and set since the last frame."""
        while not self._clicks.empty():
            self._clicks.get()()
        if self._reading.value != self._seen_reading:
            self._seen_reading, self._picked = self._reading.value, None
            self._history.clear()
            self._channel.options = self._channels()
            self._channel.value = self._channels()[0]
            self._add_discs()
        elif self._channel.value not in self._channels():
            self._channel.value = self._channels()[0]
        if self._env_index != self._seen_env:
            self._seen_env = self._env_index
            self._history.clear()
        if self._instant is not None and int(self._instant.value) != self._seen_instant:
            self._seen_instant = int(self._instant.value)
            self.stage.seek(self._seen_instant)
        for name, handles in {**self._meshes, "taxels": self._discs.values()}.items():
            for handle in handles:
                handle.visible = self._shown[name].value
        if self._sliders and self.stage.control is not None:
            if self._keyframe.value != self._seen_keyframe:
                self._seen_keyframe = self._keyframe.value
                if self._keyframe.value:
                    self._set_sliders(self.stage.model.key(self._keyframe.value).ctrl)
            self.stage.control[:] = [slider.value for slider in self._sliders]

    def _set_sliders(self, control: Float[Array, " actuator"]) -> None:
        for slider, value in zip(self._sliders, control, strict=True):
            slider.value = float(np.clip(value, slider.min, slider.max))

    def _step_once(self) -> None:
        self._paused.value = True
        self.stage.advance()

    def _save(self, client: Any) -> None:
        """Send the saved frames to the browser that asked for them."""
        if self._frames_seen:
            client.send_file_download("seen.npz", self.saved_frames(), save_immediately=True)

    def _restart(self) -> None:
        self.stage.restart()
        self._history.clear()
        if self._sliders and self.stage.control is not None:
            self._set_sliders(self.stage.control)

    def _pick(self, row: int) -> None:
        """Show one taxel's name and reading; a second click on it shows all again."""
        self._picked = None if self._picked == row else row
        self._history.clear()


class _Table(NamedTuple):
    """Rows of a reading in the frames of their bodies."""

    body: Int[Array, " taxel"]
    rows: Taxels
    labels: list[str]


def check_viser() -> None:
    """Raise `TgdslError` if viser is not installed."""
    if find_spec("viser") is None:
        raise TgdslError("the live page needs viser: pip install 'tgdsl[view]'")


def drawn(stage: Stage) -> dict[str, Output]:
    """Return the readings that a page can show, by name."""
    outputs = {output.name: output for output in stage.outputs}
    if not outputs:
        raise TgdslError("no sensor of this document has taxels, bodies or cells to draw")
    return outputs


def _joined(corners: Float[Array, "face 3 3"], normals: Float[Array, "face 3 3"]) -> tuple[Array, Array]:
    """Return vertices and faces; corners are one vertex where place and normal agree, so that edges stay sharp."""
    both = np.concatenate([corners.reshape(-1, 3) * 1e6, normals.reshape(-1, 3) * 1e3], axis=1).round().astype(np.int64)
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return corners.reshape(-1, 3)[first].astype(np.float32), inverse.reshape(-1, 3).astype(np.uint32)


def _unit(unit: str) -> str:
    return {"1": "", "degC": "°C"}.get(unit, unit)


def _legend(colours: Colormap, norm: Normalize, label: str) -> str:
    """Return the colour bar as HTML."""
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
    stops = ", ".join(to_hex(colours(x)) for x in np.linspace(0, 1, 9))
    low_text = "0" if abs(low) < 1e-11 else f"{low:.3g}"
    return (
        f'<div style="padding:0 0.75em"><div>{label}</div>'
        f'<div style="height:0.7em;background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{low_text}</span><span>{high:.3g}</span></div></div>'
    )

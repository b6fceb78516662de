"""A live page in the browser: robot and objects, taxels coloured by what they read, and the controls of a scene.

The page is served by viser, an optional package: `pip install tgdsl[view]`.
"""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import BytesIO, StringIO
from queue import SimpleQueue
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from tgdsl.errors import TgdslError
from tgdsl.module.outputs import Output
from tgdsl.view.layers import DiscLayer, Layer, Shown
from tgdsl.view.live_scene import LiveScene
from tgdsl.view.panel import EVERY, Panel, legend
from tgdsl.view.picture import HeatMaps
from tgdsl.view.sound import RANGE, RollingSound, sounding
from tgdsl.view.stages import Poses, Stage

Array = np.ndarray
LOCAL = "127.0.0.1"
PORT = 8080
FRAME = 1 / 30  # least time between two frames [s]
PLOT_SECONDS = 10.0  # how much of the past the plot shows [s]
IMAGE = 0.1  # least time between two heat maps or spectrograms [s]
SPECTROGRAM = (128, 340)  # its rows and columns of pixels
SOUND_SECONDS = 3.0  # how much of the past the spectrogram shows [s]
SAVED_FRAMES = 1800  # number of frames that the page can save: the last minute at 30 per second
NETWORK_WARNING = "the page is served at {}: whoever reaches this machine can see and control it"
VIDEO_RATE = 10.0  # frames per second of a video at most
VIDEO_SECONDS = 60.0  # how long a video is at most [s]
_VIDEO_ROWS = 400  # rows of pixels of a video
_PATIENCE = 20.0  # longest wait for one frame [s]
_RECORD = ("record video", "stop and save video")  # label of the button before and during a recording


class Page:
    """A page that shows a stage, and whose controls act on it.

    Open it in any number of browsers; closing or reloading one changes nothing.

    Args:
        stage: The scene; see `show` for another.
        host: Address to serve at; any but the local one lets others in the network see and control the scene.
        port: Port; if it is in use, the next free one.
    """

    def __init__(self, stage: Stage, host: str = LOCAL, port: int = PORT):
        drawn(stage)
        self.server = serve(host, port)
        self._recording: threading.Event | None = None  # ends the video that is being recorded
        self.show(stage)

    @property
    def url(self) -> str:
        """The page's address."""
        return url_of(self.server)

    def show(self, stage: Stage) -> None:
        """Replace the shown stage; the camera stays.

        Raises:
            TgdslError: If the stage has nothing to draw; the previous one stays.
        """
        outputs = drawn(stage)
        is_first = not hasattr(self, "stage")
        reading = None if is_first else self.panel.reading.value
        self.stage, self._outputs = stage, outputs
        self._picked: int | None = None
        self._seen: dict[str, Any] = {"env": 0, "instant": 0, "group": EVERY, "plotted": EVERY, "keyframe": ""}
        self._history: deque[tuple[float, float]] = deque()
        self._frames_seen: deque[dict[str, Array]] = deque(maxlen=SAVED_FRAMES)
        self._images_due = 0.0  # when heat maps, spectrogram and observations are drawn again
        self._maps: dict[str, HeatMaps] = {}
        heard = sounding(stage.touch.plan) if stage.is_gapless else ()
        self._sounds = {sensor.name: RollingSound(sensor.name, sensor.readings[0].units[0], SOUND_SECONDS) for sensor in heard}
        self._clicks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        later = self._clicks.put
        with self.server.atomic():
            self.server.scene.reset()
            self.server.gui.reset()
            self.scene = LiveScene(self.server, stage, outputs, lambda row: later(lambda: self._pick(row)))
            self.panel = panel = Panel(self.server.gui, stage, outputs, list(self._sounds), reading)
            acts = {"step once": self._step_once, "restart": self._restart}
            panel.time.on_click(lambda event: later(acts[event.target.value]))
            panel.screenshot.on_click(lambda event: send_picture(event.client))
            panel.record.on_click(lambda event: self._record_video(event.client))
            panel.save.on_click(lambda event: later(lambda: self._save(event.client)))
            panel.record.label = _RECORD[self._recording is not None]
            self._react()
        self.draw()
        if is_first:
            self.scene.place_camera(self.scene.layers[0].rows)

    def run(self, watch: Callable[[], Stage | str | None] = lambda: None, seconds: float = math.inf) -> None:
        """Step the stage in real time and draw it, for some seconds or until interrupted.

        `watch` is called before each frame and returns another stage to show, an error message about it, or None for no change.
        """
        begin = last_frame = time.monotonic()
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
                self.panel.problem.content = f"```\n{change}\n```"
            self._react()
            due = 0.0 if self.panel.paused.value else due + self.panel.speed.value * (start - last_frame)
            last_frame = start
            deadline = time.monotonic() + FRAME
            while due >= self.stage.control_step and time.monotonic() < deadline:
                self._advance()
                due -= self.stage.control_step
            due = min(due, self.stage.control_step)  # a scene of slow steps runs behind real time
            self.draw()
            time.sleep(max(0.0, FRAME - (time.monotonic() - start)))

    def close(self) -> None:
        """Stop serving."""
        stop(self.server)

    def draw(self) -> None:
        """Draw the stage as it is now."""
        env, now = self.panel.env_index, time.monotonic()
        poses = self.stage.body_poses(env)
        with_images = now >= self._images_due
        if with_images:
            self._images_due = now + IMAGE
        with self.server.atomic():
            self.scene.move(poses, env)
            if self.stage.readings:
                self._draw_touch(env, poses, with_images)
            self._draw_text(self._draw_contacts(env), with_images)
        self._record(env, *poses)

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
        """Store a frame for `saved_frames`, each instant of one environment once."""
        last = self._frames_seen[-1] if self._frames_seen else None
        if not self.stage.readings or (last is not None and (last["time"], last["env"]) == (self.stage.time, env)):
            return
        frame = {"time": np.array(self.stage.time), "env": np.array(env), "body_pos": pos.copy(), "body_quat": quat.copy()}
        readings = {o.name: self.stage.readings[o.name][env].detach().cpu().numpy().copy() for o in self._outputs.values()}
        self._frames_seen.append({**readings, **frame})

    # Touch -----------------------------------------------------------------------------------------------------------------

    def _draw_touch(self, env: int, poses: Poses, with_images: bool) -> None:
        """Colour the readings; draw arrows, the legend, the picked row's name and the plot."""
        panel, links = self.panel, self.panel.shown_links
        for layer in self.scene.layers[1:]:
            layer.paint(layer.read(self.stage.readings[layer.output.name], env, layer.channels[0]).colour)
        layer = self.scene.layers[0]
        rows, current = layer.rows, layer.read(self.stage.readings[layer.output.name], env, panel.channel.value)
        layer.paint(current.colour)
        is_shown = np.isin(rows.link, list(links))
        self.scene.draw_arrows(rows, current, poses, is_shown & panel.parts["arrows"].value)
        panel.legend.content = legend(current)
        if with_images:
            self._draw_images(layer, current)
        if self._picked is not None:
            value, name = float(current.value[self._picked]), f"**{rows.label[self._picked]}**"
            self.scene.name_row(rows, self._picked, poses, f"{rows.label[self._picked]}: {value:.4g} {current.unit}")
            name += f" at ({', '.join(f'{1e3 * part:.1f}' for part in rows.pos[self._picked])}) mm"
        else:
            is_meant = is_shown if panel.plotted.value == EVERY else rows.link == panel.plotted.value
            value = float(getattr(np, layer.total)(current.value[is_meant])) if is_meant.any() else 0.0
            name = f"**{layer.total}**" if panel.plotted.value == EVERY else f"**{layer.total} of {panel.plotted.value}**"
            self.scene.name_row(rows, None, poses)
        panel.value.content = f"{name}: {current.quantity} {value:.4g} {current.unit}"
        while self._history and self.stage.time <= self._history[-1][0]:
            self._history.pop()
        self._history.append((self.stage.time, value))
        while self.stage.time - self._history[0][0] > PLOT_SECONDS:
            self._history.popleft()
        if len(self._history) > 1:
            times, values = np.array(self._history).T
            panel.plot.data = (times, values)

    def _draw_images(self, layer: Layer, shown: Shown) -> None:
        """Draw the heat maps of taxels, and the spectrogram of the chosen sound."""
        panel, output = self.panel, layer.output
        panel.maps.visible = panel.parts["heat maps"].value and output.rows == "taxel" and isinstance(layer, DiscLayer)
        if panel.maps.visible:
            if output.sensor not in self._maps:
                self._maps[output.sensor] = HeatMaps(self.stage.model, self.stage.touch.taxels[output.sensor])
            panel.maps.image = self._maps[output.sensor].image(shown.colour)
        if panel.sound is not None and panel.spectrogram is not None:
            sound = self._sounds[panel.sound.value]
            panel.spectrogram.image = sound.image(*SPECTROGRAM)
            top = f"0 to {sound.sound.rate / 2000:.3g} kHz upward"
            panel.spectrogram.label = f"last {SOUND_SECONDS:g} s, {top}, {RANGE:g} dB below the loudest"

    def _advance(self) -> None:
        """Make one control step, and keep its sound."""
        self.stage.advance()
        for name, sound in self._sounds.items():
            block = self.stage.readings[name][self.panel.env_index].detach().double().sum(dim=(1, 2)).cpu().numpy()
            sound.add(block, self.stage.time, self.stage.control_step)

    def _draw_contacts(self, env: int) -> str:
        """Draw the contacts if they are switched on; return what there is to say of them."""
        contacts = self.stage.contacts(env) if self.panel.parts["contacts"].value else None
        self.scene.draw_contacts(contacts)
        if contacts is None:
            return ""
        text = f" · {len(contacts.pos)} contact{'s' * (len(contacts.pos) != 1)}"
        if contacts.force is None or not len(contacts.pos):
            return text
        return f"{text}, largest {np.linalg.norm(contacts.force, axis=1).max():.3g} N"

    def _draw_text(self, contacts: str, with_observations: bool) -> None:
        """Write the time, and what the stage notes."""
        env = self.panel.env_index
        notes = self.stage.notes(env)
        rows = [f"\n| {name} | {f'{value:.4g}' if isinstance(value, float) else value} |" for name, value in notes.items()]
        self.panel.notes.content = f"| | |\n|---|---|{''.join(rows)}" if rows else ""
        group, values_shown = self.panel.observed, self.panel.group_values
        if group is not None and values_shown is not None and with_observations:
            rows = [f"\n| {name} | {_range(values)} | {unit} |" for name, unit, values in self.stage.observed(group.value, env)]
            values_shown.content = f"| | | |\n|---|---|---|{''.join(rows)}"
        layer = self.scene.layers[0]
        things = "taxels" if isinstance(layer, DiscLayer) else "cells"
        self.panel.status.content = f"t = {self.stage.time:.2f} s · {len(layer.rows.body)} {things}{contacts}"
        instant = self.panel.instant
        # where a browser has moved the slider since `_react`, its value stays for the next frame
        if instant is not None and self.stage.step_index != self._seen["instant"] == int(instant.value):
            instant.value = self._seen["instant"] = self.stage.step_index

    # Controls --------------------------------------------------------------------------------------------------------------

    def _react(self) -> None:
        """Apply the clicks and settings since the last frame."""
        while not self._clicks.empty():
            self._clicks.get()()
        panel = self.panel
        if self._changed("readings", panel.readings):
            self._show_readings()
        elif panel.channel.value not in self.scene.layers[0].channels:
            panel.channel.value = self.scene.layers[0].channels[0]
        if self._changed("channel", panel.channel.value):
            self._history.clear()
        if self._changed("env", panel.env_index) | self._changed("plotted", panel.plotted.value):
            self._history.clear()
            for sound in self._sounds.values():
                sound.clear()
            if self._picked is not None and panel.plotted.value != EVERY:
                self._picked = None
        if panel.instant is not None and self._changed("instant", int(panel.instant.value)):
            self.stage.seek(self._seen["instant"])
        if self._changed("group", panel.group.value):
            group = self.stage.touch.plan.layout.groups.get(panel.group.value, panel.links)
            for name, box in panel.links.items():
                box.value = name in group
        parts = {name: panel.parts[name].value for name in ("robot", "objects", "taxels")}
        self.scene.show(**parts, plain=panel.is_plain.value, links=panel.shown_links)
        if not panel.sliders or self.stage.control is None:
            return
        if panel.keyframe is not None and self._changed("keyframe", panel.keyframe.value) and panel.keyframe.value:
            panel.set_sliders(self.stage.model.key(panel.keyframe.value).ctrl)
        if panel.by_hand is not None:
            self.stage.by_hand = panel.by_hand.value
            if not panel.by_hand.value and (action := self.stage.acted(panel.env_index)) is not None:
                panel.set_sliders(action)
        self.stage.control[:] = [slider.value for slider in panel.sliders]

    def _changed(self, name: str, value: Any) -> bool:
        """Return whether a control is set to something else than before."""
        is_new = self._seen.get(name) != value
        self._seen[name] = value
        return is_new

    def _show_readings(self) -> None:
        """Draw the readings that are chosen."""
        previous = self.scene.layers[0].output.name if self.scene.layers else None
        self.scene.show_readings(self.panel.readings)
        layer = self.scene.layers[0]
        if layer.output.name != previous:
            self._picked = None
            self._history.clear()
            self.panel.channel.options = layer.channels
            self.panel.plotted.options = (EVERY, *dict.fromkeys(layer.rows.link.tolist()))
            self.panel.channel.value, self.panel.plotted.value = layer.channels[0], EVERY

    def _step_once(self) -> None:
        self.panel.paused.value = True
        self._advance()

    def _save(self, client: Any) -> None:
        """Send the saved frames to the browser that asked for them."""
        if self._frames_seen:
            client.send_file_download("seen.npz", self.saved_frames(), save_immediately=True)

    def _record_video(self, client: Any) -> None:
        """Record a browser's view until a second click, and send the video to that browser."""
        if self._recording is not None:
            self._recording.set()
            return
        self._recording = threading.Event()
        self.panel.record.label = _RECORD[True]
        video = record(client, self._recording)
        self._recording = None
        self.panel.record.label = _RECORD[False]
        if video is not None:
            client.send_file_download("view.gif", video, save_immediately=True)

    def _restart(self) -> None:
        self.stage.restart()
        if self.panel.sliders and self.stage.control is not None:
            self.panel.set_sliders(self.stage.control)

    def _pick(self, row: int) -> None:
        """Name a row and plot it; a second click on it shows all again."""
        self._picked = None if self._picked == row else row
        self._history.clear()
        if self._picked is not None:
            self.panel.plotted.value = self._seen["plotted"] = EVERY


def _range(values: Float[Array, " feature"]) -> str:
    """Return one number, or the least and the largest of several."""
    return " … ".join(dict.fromkeys(f"{end:.3g}" for end in (values.min(), values.max()))) if len(values) else ""


def serve(host: str = LOCAL, port: int = PORT) -> Any:
    """Return viser's server of a page that is empty; see `Page`."""
    check_viser()
    import viser

    with redirect_stdout(StringIO()):  # viser prints its address
        server = viser.ViserServer(host=host, port=port, label="tgdsl view", verbose=False)
    server.gui.configure_theme(show_share_button=False)  # its tunnel would lead to the internet
    if host != LOCAL:
        warnings.warn(NETWORK_WARNING.format(host), stacklevel=3)
    return server


def url_of(server: Any) -> str:
    """Return the address of a server's page."""
    host = server.get_host()
    return f"http://{'localhost' if host == LOCAL else host}:{server.get_port()}"


def stop(server: Any) -> None:
    """Stop serving a page."""
    with redirect_stdout(StringIO()):
        server.stop()


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


def view_of(client: Any, rows: int | None = None) -> UInt8[Array, "h w 3"]:
    """Return what a browser's camera sees, without the controls; default: as many pixels as the window has.

    Raises:
        TimeoutError: If the browser does not answer; viser raises another error where it is gone.
    """
    height, width = client.camera.image_height, client.camera.image_width
    size = (height, width) if rows is None else (rows, round(rows * width / height))
    return client.get_render(*size, transport_format="jpeg", timeout=_PATIENCE)[..., :3]


def send_picture(client: Any) -> None:
    """Send a picture of a browser's view to it, as a PNG file."""
    file = BytesIO()
    Image.fromarray(view_of(client)).save(file, "PNG", optimize=True)
    client.send_file_download("view.png", file.getvalue(), save_immediately=True)


def record(client: Any, is_over: threading.Event) -> bytes | None:
    """Return a GIF file of a browser's view that plays in real time; None if no frame came.

    Frames are requested until `is_over` is set, for `VIDEO_SECONDS`, or until the browser disconnects.
    """
    frames: list[tuple[float, Image.Image]] = []
    begin = start = time.monotonic()
    try:
        while not is_over.is_set() and start - begin < VIDEO_SECONDS:
            image = Image.fromarray(view_of(client, _VIDEO_ROWS))
            frames.append((start, image.convert("P", palette=Image.Palette.ADAPTIVE)))
            is_over.wait(max(0.0, 1 / VIDEO_RATE - (time.monotonic() - start)))
            start = time.monotonic()
    except (TimeoutError, RuntimeError):  # the browser is gone: the video ends here
        pass
    if not frames:
        return None
    times, images = zip(*frames, strict=True)
    durations = np.diff([*times, times[-1] + 1 / VIDEO_RATE]) * 1e3
    file = BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=durations.round().tolist(), loop=0)
    return file.getvalue()

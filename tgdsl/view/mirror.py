"""A page in a separate process, for a loop that must not wait for it.

    page = tgdsl.show(touch, sim)
    for control in controls:
        sim.step(control)
        page.update(touch(sim.state()))

The page asks the loop for a frame, one environment's poses and readings, when a browser is connected and the frame before is
drawn, at most 30 times per second. Where it has not asked, `update` does nothing. The page's process has the lowest priority:
it takes the processor time that the loop leaves.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from types import SimpleNamespace
from typing import IO, Any, BinaryIO, NamedTuple, cast

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import outputs_of
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.meshes import shapes_of
from tgdsl.view.page import FRAME, LOCAL, NETWORK_WARNING, PORT, Page, check_viser, drawn
from tgdsl.view.stages import Poses, SimStage, Stage

Array = np.ndarray
BROWSER_LOOK = 0.2  # time between looks for a browser [s]
PRIORITY, LOWEST_PRIORITY = 10, 19  # of the page's process, as `nice` has it
_CHILD = "from tgdsl.view.mirror import serve; serve()"


class Frame(NamedTuple):
    """One environment at one instant."""

    env: int
    time: float  # [s]
    pos: Float[Array, "body 3"]  # in the world [m]
    quat: Float[Array, "body 4"]  # w, x, y, z
    readings: Mapping[str, Array]  # by name, without `env`
    notes: Mapping[str, float | str]
    state: Mapping[str, Array] | None  # see `Stage.state`
    model: mujoco.MjModel | None  # of this environment, if its shapes differ from the previous frame's


class _Opening(NamedTuple):
    """What the page's process begins with."""

    tables: SimpleNamespace  # see `_tables`
    model: mujoco.MjModel
    num_envs: int
    frame: Frame
    host: str
    port: int
    priority: int = PRIORITY


class LoopPage:
    """The page of a user's loop. Its process ends with `close`, or with the loop's process."""

    def __init__(self, stage: Stage, host: str = LOCAL, port: int = PORT, priority: int = PRIORITY):
        """Open the page of a stage that the loop advances; see `Page` for host and port.

        Raises:
            TgdslError: If viser is not installed, or the stage has nothing to draw.
        """
        drawn(stage)
        check_viser()
        if host != LOCAL:
            warnings.warn(NETWORK_WARNING.format(host), stacklevel=3)
        self._stage, self._is_closed = stage, False
        self.num_frames = 0  # how many frames were sent
        self._wanted: int | None = None  # environment of the frame that the page waits for
        self._frames: SimpleQueue[Frame] = SimpleQueue()
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        env = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        self._process = subprocess.Popen([sys.executable, "-c", _CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env)
        self._shapes = shapes_of(stage.model)  # of the model that the page has
        frame, tables = self._frame(0), _tables(stage.touch)
        _send(_Opening(tables, stage.model, stage.num_envs, frame, host, port, priority), self._process.stdin)
        try:
            answer = pickle.load(cast(BinaryIO, self._process.stdout))
        except EOFError:
            answer = TgdslError("the page's process has ended before the page was open")
        if isinstance(answer, TgdslError):
            self.close()
            raise answer
        self.url: str = answer
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def update(self, readings: Mapping[str, Tensor]) -> None:
        """Take the readings of the simulation's instant, after each control step; they are sent if the page has asked."""
        assert isinstance(self._stage, SimStage)
        self._stage.update(readings)
        self.refresh()

    def refresh(self) -> None:
        """Send the stage's frame if the page has asked for one."""
        env, self._wanted = self._wanted, None
        if env is not None:
            self._frames.put(self._frame(env))
            self.num_frames += 1

    def close(self) -> None:
        """End the page and its process."""
        self._is_closed = True
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            cast(BinaryIO, pipe).close()

    def _frame(self, env: int) -> Frame:
        frame = frame_of(self._stage, env, self._shapes)
        self._shapes = self._shapes if frame.model is None else shapes_of(frame.model)
        return frame

    def _answer(self) -> None:
        """Answer each request of the page with the next frame."""
        try:
            while True:
                self._wanted = pickle.load(cast(BinaryIO, self._process.stdout))
                _send(self._frames.get(), self._process.stdin)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):  # it has ended
            if not self._is_closed:
                print("tgdsl view: the page's process has ended; the loop goes on without it", file=sys.stderr)


def show(touch: TactileModule, sim: Simulation, *, host: str = LOCAL, port: int = PORT) -> LoopPage:
    """Show a simulation of your own loop in the browser; call the page's `update` with the readings of each step.

    Args:
        touch: The module.
        sim: The simulation.
        host: Address of the server: see `Page`.
        port: Port of the server.

    Raises:
        TgdslError: If viser is not installed, or the module has nothing to draw.
    """
    page = LoopPage(SimStage(touch, sim), host, port)
    print(f"tgdsl view: {page.url}")
    return page


def frame_of(stage: Stage, env: int, shapes: bytes) -> Frame:
    """Return a frame for a page that has a model of these shapes."""
    pos, quat = stage.body_poses(env)
    model = stage.env_model(env)
    is_other = bool(stage.touch.inputs.objects) and shapes_of(model) != shapes
    readings = {o.name: stage.readings[o.name][env].detach().cpu().numpy().copy() for o in stage.outputs if stage.readings}
    notes, other = dict(stage.notes(env)), model if is_other else None
    return Frame(env, stage.time, pos.copy(), quat.copy(), readings, notes, stage.state(env), other)


def _send(value: Any, sink: IO[bytes] | None) -> None:
    assert sink is not None
    pickle.dump(value, sink)
    sink.flush()


def _tables(touch: TactileModule) -> SimpleNamespace:
    """Return what a page reads of a module; its plan without constants, which may be large, or of classes of a script."""
    bare: dict[str, Any] = {"constants": {}, "state": {}, "noise": None}
    sensors = tuple(replace(sensor, **bare) for sensor in touch.plan.sensors)
    plan = replace(touch.plan, quantities={}, observations=(), sensors=sensors)
    return SimpleNamespace(plan=plan, outputs=tuple(outputs_of(plan)), taxels=dict(touch.taxels), rows=dict(touch.rows))


# In the page's process -----------------------------------------------------------------------------------------------------


class MirrorStage(Stage):
    """The stage of another process, frame by frame."""

    control_step = FRAME
    is_gapless = False

    def __init__(self, opening: _Opening, source: BinaryIO, sink: BinaryIO):
        self.touch = cast(TactileModule, opening.tables)
        self.model, self.num_envs = opening.model, opening.num_envs
        self._source, self._sink, self._env_model = source, sink, opening.model
        self._arrived: SimpleQueue[Frame] = SimpleQueue()
        self._env, self._is_waiting, self.is_over = opening.frame.env, False, False
        self._take(opening.frame)
        threading.Thread(target=self._listen, daemon=True).start()

    def advance(self) -> None:
        """Take the frame that has come, if one has, and ask for the next one."""
        with suppress(Empty):
            self._take(self._arrived.get_nowait())
            self._is_waiting = False
        if not self._is_waiting:
            self._is_waiting = True
            _send(self._env, self._sink)

    def restart(self) -> None:
        """Do nothing: the loop controls itself."""

    def notes(self, env: int) -> Mapping[str, float | str]:
        """Return what the other process notes."""
        return self._frame.notes

    def body_poses(self, env: int) -> Poses:
        """Return the poses of the last frame; without readings if it is of another environment."""
        self._env = env
        if self._frame.env != env:
            self.readings = {}
        return self._frame.pos, self._frame.quat

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of the last frame's environment."""
        return self._env_model

    def state(self, env: int) -> Mapping[str, Array] | None:
        """Return the state of the last frame."""
        return self._frame.state

    def _take(self, frame: Frame) -> None:
        self._frame, self.time = frame, frame.time
        self._env_model = self._env_model if frame.model is None else frame.model
        values = {name: torch.from_numpy(array) for name, array in frame.readings.items()}
        self.readings = {name: value.expand(self.num_envs, *value.shape) for name, value in values.items()}

    def _listen(self) -> None:
        with suppress(EOFError, pickle.UnpicklingError):  # the loop's process has ended
            while True:
                self._arrived.put(pickle.load(self._source))
        self.is_over = True


def serve() -> None:
    """Serve the page of another process, until that ends: its frames come in by stdin, requests go out by stdout."""
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no request
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the loop's
    opening: _Opening = pickle.load(sys.stdin.buffer)
    stage = MirrorStage(opening, sys.stdin.buffer, sink)
    try:
        with warnings.catch_warnings(action="ignore"):  # the loop's process warns of the network
            page = Page(stage, opening.host, opening.port)
    except TgdslError as error:
        _send(TgdslError(str(error)), sink)
        return
    _send(page.url, sink)
    if hasattr(os, "nice"):
        os.nice(opening.priority)
    while not stage.is_over:
        if page.server.get_clients():
            page.run(seconds=BROWSER_LOOK)
        else:
            time.sleep(BROWSER_LOOK)
    os._exit(0)  # without waiting for browsers

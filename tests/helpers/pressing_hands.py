"""A small XHand1 that presses on a plate as a task, and policies that act on it."""

import json
from pathlib import Path

import numpy as np
import torch
from xhand1_models import JOINTS, TIPS, document, hand_xml

from tgdsl.rl.load import load_task
from tgdsl.runtime.xhand1.calibration import Calibration

ORDER = [str(name) for name in np.random.default_rng(1).permutation(JOINTS)]
"""Of the actuators: neither the hand's nor the model's."""
PRESS = '''"""Bend the joints until their sum is the commanded one."""

import torch

from tgdsl.errors import LowerError
from tgdsl.fields.models import Number
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.task import Start, Task


class PressSpec(TaskSpec):
    """The document."""

    bend: tuple[Number, Number] = (0.5, 1.5)
    """Least and largest sum that is asked for [rad]."""


class Press(Task[PressSpec]):
    """The task."""

    Spec = PressSpec
    score_unit = "rad"
    is_less_better = True
    hand_groups = ("goal",)
    goal_units = ("rad",)

    def __init__(self, spec, setup):
        super().__init__(spec, setup)
        self.wanted, self.error = self.keep("wanted"), self.keep("error")

    def reset(self, chosen, episode):
        self.begin(chosen, wanted=self.setup.draws.uniform("bend", episode, 1, *self.spec.bend)[:, 0], error=0.0)
        return Start({"qpos": self.setup.qpos})

    def advance(self, now):
        self.error.copy_((now.joint_pos.sum(dim=1) - self.wanted).abs())

    def is_over(self, now):
        return torch.zeros_like(self.error, dtype=torch.bool)

    def reward(self, now, is_over):
        return {"near": -self.error}

    def asked(self):
        return self.wanted[:, None]

    def observe(self, now):
        return {"goal": self.asked(), "priv_error": self.error[:, None]}

    @classmethod
    def observe_hand(cls, spec, now):
        return {"goal": now.goal}

    @classmethod
    def asked_for(cls, spec, goal):
        if not spec.bend[0] <= goal[0] <= spec.bend[1]:
            raise LowerError(f"a bend of {goal[0]:g} rad", "bend", f"expected {spec.bend[0]:g} to {spec.bend[1]:g} rad")
        return spec.model_copy(update={"bend": (goal[0], goal[0])})

    def score(self):
        return self.error
'''
TASK = """tgdsl: 1
task: press.py:Press
document: sensors.yaml
object: plate
joints: ["{side}_hand_thumb_*", "{side}_hand_mid_*", {side}_hand_index_joint2]
episode: 0.5 s
touch: agg_force
placement: tips
physics: {{timestep: 4 ms, substeps: 5}}
action: {{mode: relative, scale: 0.05 rad, smoothing: 0.2}}
randomise: {{drive: {{gain: [0.9, 1.1], bias: [-0.01 rad, 0.01 rad], backlash: [0, 0.01 rad], delay: [0, 2]}}}}
"""
TURN = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""The sensor's z is the link's x, which presses."""
SCALE = 2.0
CALIBRATION = Calibration(
    "counts", np.full((5, 3), SCALE), np.tile(TURN, (5, 1, 1)), np.zeros((5, 3)), np.zeros((5, 3)), "", 3.0
)


def press_task(folder: Path, side: str = "right", **sensors) -> Path:
    """Write robot, sensors, task and its code into a folder; return the task's document."""
    made = document(folder, {}, hand_xml(side, ORDER), side, **sensors)
    made["robot"]["layout"]["groups"] = {"tips": [f"{side}_hand_{name}" for name in TIPS]}
    (folder / "sensors.yaml").write_text(json.dumps(made))
    (folder / "press.py").write_text(PRESS)
    (folder / "task.yaml").write_text(TASK.format(side=side))
    return folder / "task.yaml"


class Blind(torch.nn.Module):
    """Actions that follow from the command and the last action alone, so that touch has no effect on them."""

    def __init__(self, actions: int):
        super().__init__()
        self.actions = actions
        self.register_buffer("phase", torch.linspace(0.0, 2.0, actions))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        last = x[:, 2 * self.actions : 3 * self.actions]
        return 0.7 + 0.25 * torch.cos(self.phase + 2.0 * last + x[:, -1:])


def press_policy(folder: Path, task: Path, module=None, name: str = "student.pt", **overrides) -> Path:
    """Write a policy that sees `proprio`, touch and `goal`; return its file."""
    from written_teachers import teacher

    loaded = load_task(task, overrides)
    return teacher(folder / name, loaded, ["proprio", "tactile_sensors", "goal"], module)

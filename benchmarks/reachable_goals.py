"""How many goals of in_hand_repose in a row a planner reaches that knows the physics: what a hand can do, whatever is learned.

    python benchmarks/reachable_goals.py                                                       # the XHand1, about the vertical
    python benchmarks/reachable_goals.py --set goal_axis=any --episodes 8
    python benchmarks/reachable_goals.py examples/tasks/in_hand_repose_sharpa.yaml

Each control step is one of the task's environment, with drives that are ideal and without pushes: goals, ends and score are the
task's. Every five steps the planner simulates 48 sequences of targets 0.75 s ahead, by the episode's own friction and mass, and
goes on with the mean of those that bring the object nearest to its goal (model predictive path integral control).
"""

from __future__ import annotations

import argparse
import math
import statistics
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from mujoco import rollout

from tgdsl.rl.env import TouchEnv

TASK = Path(__file__).parents[1] / "examples" / "tasks" / "in_hand_repose.yaml"
SAMPLES, KNOTS, EACH = 48, 6, 5
"""Sequences of targets; their parts, and control steps of each, after which the plan is made again."""
KEPT = 6
"""Sequences that the next plan is a mean of."""
SPREADS = (0.2, 0.5, 1.0)
"""Standard deviations of actions."""
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
Array = np.ndarray


class Planner:
    """Plans the actions of one environment."""

    def __init__(self, env: TouchEnv, row: int):
        """Begin with a plan to rest; `row` is which of the environments is planned for."""
        setup, self.row = env.task.setup, row
        self.env, self.scale, self.actuators = env, env.actuation.scale.numpy(), setup.actuators
        self.item = env.sim.model.body(setup.object).id
        self.tips = sorted({env.sim.model.body(body).id for body in env.touch.rows["gap"]["body"].tolist()})
        self.random, self.plan = np.random.default_rng(row), np.zeros((KNOTS, env.num_actions))

    def actions(self) -> Float[Array, "step joint"]:
        """Return the next actions, from where the environment is now."""
        sim, own = self.env.sim, self.actuators
        model, shape = sim.env_model(self.row), self.plan.shape
        spread = self.random.choice(SPREADS, size=(SAMPLES, 1, 1))
        tried = np.clip(self.plan + spread * self.random.normal(size=(SAMPLES, *shape)), -1.0, 1.0)
        tried[0], tried[1] = self.plan, 0.0
        steps = np.repeat(tried, EACH, axis=1)
        target = np.repeat(sim.ctrl[self.row].numpy()[None, None], KNOTS * EACH, axis=1).repeat(SAMPLES, axis=0)
        moved = target[:, 0, own.actuator]
        for i in range(steps.shape[1]):
            moved = np.clip(moved + self.scale * steps[:, i], own.low, own.high)
            target[:, i, own.actuator] = moved
        cost = self._cost(model, target) + 0.02 * (0.25 * tried**2).sum(axis=(1, 2)) / shape[1]
        best = np.argsort(cost)[:KEPT]
        share = np.exp((cost[best[0]] - cost[best]) / 0.02)
        self.plan = np.tensordot(share / share.sum(), tried[best], 1)
        made, self.plan = self.plan[0], np.vstack([self.plan[1:], np.zeros((1, shape[1]))])
        return np.repeat(made[None], EACH, axis=0)

    def _cost(self, model: mujoco.MjModel, target: Float[Array, "sample step nu"]) -> Float[Array, " sample"]:
        """Return what sequences of targets cost: angle to the goal, distance from the start, fingertips that are far off."""
        sim, task, state = self.env.sim, self.env.task, mujoco.MjData(model)
        state.qpos[:], state.qvel[:] = sim.qpos[self.row].numpy(), sim.qvel[self.row].numpy()
        begin = np.zeros(mujoco.mj_stateSize(model, FULL))
        mujoco.mj_getState(model, state, begin, FULL)
        substeps = self.env.spec.physics.substeps
        states, _ = rollout.rollout(model, state, np.tile(begin, (SAMPLES, 1)), np.repeat(target, substeps, axis=1))
        qpos = states[:, substeps - 1 :: substeps, 1 : 1 + model.nq]
        first = int(model.jnt_qposadr[model.body_jntadr[self.item]])
        pos, quat = qpos[..., first : first + 3], qpos[..., first + 3 : first + 7]
        goal, start = (task.memory[name][self.row].numpy() for name in ("goal", "start_pos"))
        angle = 2.0 * np.arccos(np.clip(abs(quat @ goal), 0.0, 1.0))
        far = np.linalg.norm(pos - start, axis=-1)
        late = np.linspace(0.5, 1.5, angle.shape[1])
        cost = (late * angle).mean(axis=1) + angle[:, -EACH:].mean(axis=1)
        cost += 20.0 * np.maximum(0.0, far - 0.03).mean(axis=1) + 10.0 * (far[:, -1] > 0.07)
        return cost + 3.0 * np.array([self._gap(model, state, rows) for rows in qpos[:, EACH - 1 :: EACH]])

    def _gap(self, model: mujoco.MjModel, state: mujoco.MjData, qpos: Float[Array, "instant nq"]) -> float:
        """Return how far the fingertips are from the object, on average [m]."""
        gaps = []
        for row in qpos:
            state.qpos[:] = row
            mujoco.mj_kinematics(model, state)
            mujoco.mj_comPos(model, state)
            gaps.append(np.linalg.norm(state.xipos[self.tips] - state.xipos[self.item], axis=1))
        return float(np.maximum(0.0, np.array(gaps) - 0.03).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", type=Path, default=TASK)
    parser.add_argument("--episodes", type=int, default=16, help="each has the next one of the objects")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    overrides = {"touch": "none", "randomise.drive": {}, "randomise.push": {}, "physics.cone": "pyramidal"}
    overrides |= {"action": {"mode": "relative", "scale": "0.05 rad"}} | dict(one.split("=", 1) for one in given.set)
    env = TouchEnv(given.task, given.episodes, threads=1, seed=given.seed, overrides=overrides)
    planners, scores = [Planner(env, row) for row in range(given.episodes)], {}
    while len(scores) < given.episodes:
        ahead = np.zeros((EACH, given.episodes, env.num_actions))
        for row in set(range(given.episodes)) - scores.keys():
            ahead[:, row] = planners[row].actions()
        for action in ahead:
            made = env.step(torch.from_numpy(action).float())
            for row in set(made.info.ended.nonzero().flatten().tolist()) - scores.keys():
                scores[row] = int(made.info.score[row])
                ends = [name for name in ("drop", "goal_timeout") if made.info.terms[name][row]] or ["whole"]
                lasted = float(made.info.episode_steps[row]) * env.control_step
                print(f"object {row % 16}: {scores[row]} goals in a row, {ends[0]}, {lasted:.1f} s", flush=True)
    found = list(scores.values())
    spread = statistics.stdev(found) / math.sqrt(len(found)) if len(found) > 1 else math.nan
    print(f"mean {statistics.mean(found):.2f} ± {spread:.2f}, median {statistics.median(found):g}")


if __name__ == "__main__":
    main()

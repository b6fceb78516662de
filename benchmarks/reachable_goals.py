"""Count the goals of in_hand_repose in a row that a planner with the true physics reaches, as an estimate of what is possible.

    python benchmarks/reachable_goals.py                                                       # the XHand1, about the vertical
    python benchmarks/reachable_goals.py --set goal_axis=any --episodes 8
    python benchmarks/reachable_goals.py examples/tasks/in_hand_repose_sharpa.yaml

Control steps, goals, ends and score are the task's; drives are ideal, and there are no pushes. Every five steps the planner
simulates 48 sequences of targets 0.75 s ahead, with the episode's friction and mass. It follows a mean of the sequences that
bring the object closest to its goal (model predictive path integral control).
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
"""Sequences of targets, their knots, and control steps per knot, after which the planner plans again."""
NUM_BEST = 6
"""Sequences whose mean is the next plan."""
SPREADS = (0.2, 0.5, 1.0)
"""Standard deviations of actions."""
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
Array = np.ndarray


class Planner:
    """Plans the actions of one environment."""

    def __init__(self, env: TouchEnv, row: int):
        """Start with a plan to rest for the environment of a row."""
        setup, self.row = env.task.setup, row
        self.env, self.scale, self.actuators = env, env.actuation.scale.numpy(), setup.actuators
        self.item = env.sim.model.body(setup.object).id
        self.tips = sorted({env.sim.model.body(body).id for body in env.touch.rows["gap"]["body"].tolist()})
        self.random, self.plan = np.random.default_rng(row), np.zeros((KNOTS, env.num_actions))

    def actions(self) -> Float[Array, "step joint"]:
        """Return the next actions from the environment's present state."""
        sim, actuators = self.env.sim, self.actuators
        model, shape = sim.env_model(self.row), self.plan.shape
        spread = self.random.choice(SPREADS, size=(SAMPLES, 1, 1))
        samples = np.clip(self.plan + spread * self.random.normal(size=(SAMPLES, *shape)), -1.0, 1.0)
        samples[0], samples[1] = self.plan, 0.0
        steps = np.repeat(samples, EACH, axis=1)
        target = np.repeat(sim.ctrl[self.row].numpy()[None, None], KNOTS * EACH, axis=1).repeat(SAMPLES, axis=0)
        moved = target[:, 0, actuators.actuator]
        for i in range(steps.shape[1]):
            moved = np.clip(moved + self.scale * steps[:, i], actuators.low, actuators.high)
            target[:, i, actuators.actuator] = moved
        cost = self._cost(model, target) + 0.02 * (0.25 * samples**2).sum(axis=(1, 2)) / shape[1]
        best = np.argsort(cost)[:NUM_BEST]
        share = np.exp((cost[best[0]] - cost[best]) / 0.02)
        self.plan = np.tensordot(share / share.sum(), samples[best], 1)
        action, self.plan = self.plan[0], np.vstack([self.plan[1:], np.zeros((1, shape[1]))])
        return np.repeat(action[None], EACH, axis=0)

    def _cost(self, model: mujoco.MjModel, target: Float[Array, "sample step nu"]) -> Float[Array, " sample"]:
        """Return the costs of sequences of targets: angle to the goal, distance from the start, and gap of the fingertips."""
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
        """Return the mean distance of the fingertips' and the object's centres beyond 3 cm [m]."""
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
    parser.add_argument("--episodes", type=int, default=16, help="with one object each, in turn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    overrides = {"touch": "none", "randomise.drive": {}, "randomise.push": {}, "physics.cone": "pyramidal"}
    overrides |= {"action": {"mode": "relative", "scale": "0.05 rad"}} | dict(entry.split("=", 1) for entry in options.set)
    env = TouchEnv(options.task, options.episodes, threads=1, seed=options.seed, overrides=overrides)
    planners, scores = [Planner(env, row) for row in range(options.episodes)], {}
    while len(scores) < options.episodes:
        ahead = np.zeros((EACH, options.episodes, env.num_actions))
        for row in set(range(options.episodes)) - scores.keys():
            ahead[:, row] = planners[row].actions()
        for action in ahead:
            result = env.step(torch.from_numpy(action).float())
            for row in set(result.info.ended.nonzero().flatten().tolist()) - scores.keys():
                scores[row] = int(result.info.score[row])
                ends = [name for name in ("drop", "goal_timeout") if result.info.terms[name][row]] or ["whole"]
                lasted = float(result.info.episode_steps[row]) * env.control_step
                print(f"object {row % 16}: {scores[row]} goals in a row, {ends[0]}, {lasted:.1f} s", flush=True)
    goals = list(scores.values())
    spread = statistics.stdev(goals) / math.sqrt(len(goals)) if len(goals) > 1 else math.nan
    print(f"mean {statistics.mean(goals):.2f} ± {spread:.2f}, median {statistics.median(goals):g}")


if __name__ == "__main__":
    main()

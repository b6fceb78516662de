"""Small runs of learning: the small task with small networks, a few control steps each."""

from small_tasks import small_task

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.train.learner import Learner

SMALL = {
    "train.steps": 4,
    "train.epochs": 2,
    "train.mini_batches": 2,
    "train.networks.encoder.hidden": "[8]",
    "train.networks.encoder.size": 4,
    "train.networks.hidden": "[8]",
    "train.rnd.predictor": "[4]",
    "train.rnd.target": "[4]",
}
"""Overrides."""
ARGUMENTS = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
"""The same for the command line."""


def small_learner(folder, num_envs=4, seed=0, ranks=None, first_env=0, **overrides):
    """Return a learner, and its task's document as loaded."""
    loaded = load_task(small_task(folder), {**SMALL, **{key.replace("__", "."): value for key, value in overrides.items()}})
    env = TouchEnv(loaded, num_envs, seed=seed, threads=1, first_env=first_env)
    return Learner(env, loaded, seed, ranks), loaded

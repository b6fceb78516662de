"""MuJoCo before 3.17 has no `mujoco.batch`: all but simulating on a CPU goes without."""

import os
import subprocess
import sys
from pathlib import Path

CODE = """
import mujoco
if mujoco.__version__ >= "3.17":
    mujoco.__version__ = "3.16.0"
import tgdsl
touch = tgdsl.compile("xhand1_palm.yaml")
assert len(touch(touch.example_state(2))) == len(touch.outputs)
try:
    tgdsl.simulate(touch, 2)
except tgdsl.SimulationError as error:
    print(error)
"""


def test_it_compiles_and_reads_and_says_what_it_needs_to_simulate():
    examples = Path(__file__).parents[3] / "examples"
    env = os.environ | {"PYTHONPATH": str(examples.parent)}
    ran = subprocess.run([sys.executable, "-c", CODE], cwd=examples, env=env, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (
        "MuJoCo 3.1" in ran.stdout
        and "has no `mujoco.batch`" in ran.stdout
        and ran.stdout.endswith('pip install "mujoco>=3.17"\n')
    )

"""MuJoCo before 3.17 has no `mujoco.batch`: all but simulating on a CPU goes without."""

import subprocess
import sys
from pathlib import Path

CODE = """
import sys
sys.modules["mujoco.batch"] = None  # as Python notes what it could not import
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
    ran = subprocess.run([sys.executable, "-c", CODE], cwd=examples, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "has no `mujoco.batch`" in ran.stdout and ran.stdout.endswith('pip install "mujoco>=3.17"\n')

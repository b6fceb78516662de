"""A small real distillation: one student stops the finger on a ridge by touch, another has no touch."""

from pathlib import Path

import pytest
from written_teachers import FindRidge, teacher

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.evaluation import evaluate_each
from tgdsl.rl.students.keys import Teacher, student_keys, touches
from tgdsl.rl.students.learner import Distiller

TASK = Path(__file__).parents[3] / "examples" / "tasks" / "find_ridge.yaml"
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
CHOSEN = {
    "noise": "clean",
    "distill.steps": 8,
    "distill.learning_rate": 1e-3,
    "distill.networks.encoder.hidden": "[64]",
    "distill.networks.hidden": "[128, 64]",
}
EPISODES = 32


@pytest.mark.slow
def test_only_students_with_touch_reach_their_teacher(tmp_path):
    """The teacher always finds the ridge; a student without touch succeeds at best by chance, 1 in 12."""
    loaded = load_task(TASK, CHOSEN)
    ridge_teacher = Teacher(teacher(tmp_path / "teacher.pt", loaded, ["command", "tactile_sensors"], FindRidge()), loaded)
    ridge_teacher.check_taxels()
    keys = student_keys(["depth", "bool", "none"], ["tips"], ["clean"], 1)
    env = TouchEnv(loaded, 96, threads=1, touches=touches(keys, ridge_teacher.touch))
    try:
        distiller = Distiller(env, loaded, ridge_teacher.bound(env), keys, 0)
        for _ in range(25):
            distiller.iterate()
        evaluations = evaluate_each(env, distiller.acting(), len(keys), EPISODES)
    finally:
        env.close()
    scores = {key.kind[0]: evaluation.score for key, evaluation in zip(distiller.keys, evaluations, strict=True)}
    assert scores["depth"] >= 0.95 and scores["bool"] >= 0.6 and scores["none"] <= 0.3

"""Students on a GPU learn the same, captured on parallel streams, as one after another."""

import pytest
import torch
from felt_tasks import felt_task
from written_teachers import teacher

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.students.keys import Teacher, student_keys, touches
from tgdsl.rl.students.learner import Distiller
from tgdsl.rl.train.graphs import Captured, SideBySide

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU"),
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype"),
]
SMALL = {
    "distill.steps": 4,
    "distill.std": 0.1,
    "distill.clip": 0.05,
    "distill.aggregate": 2,
    "distill.precision": "float32",
    "distill.final_learning_rate": 1e-6,
    "distill.decoders": "{object_size: {scale: 20}}",
    "distill.gates": "{taxels: 2}",
}


@pytest.fixture(params=["mlp", "convrnn"])
def distillers(request, tmp_path):
    """Return two distillers with stacks of several sizes: one captured and parallel, one eager and sequential."""
    loaded = load_task(felt_task(tmp_path), SMALL | {"distill.networks.touch_kind": request.param})
    file = teacher(tmp_path / "teacher.pt", loaded, ("priv_proprio", "priv_obj_state"), std=[0.5, 0.25])
    keys, student_teacher = student_keys(["depth", "bool", "none"], ["ends", "all"], ["clean"], 2), Teacher(file, loaded)
    pair = []
    for _ in range(2):
        env = TouchEnv(loaded, 4 * len(keys), seed=1, device="cuda", touches=touches(keys, student_teacher.touch))
        pair.append(Distiller(env, loaded, student_teacher.bound(env), keys, 0))
    for part in vars(pair[1]).values():
        if isinstance(part, Captured):
            part._is_captured = False
    pair[1]._beside = SideBySide(0, "cpu")
    yield pair
    for distiller in pair:
        distiller.env.close()


def test_streams_and_graphs_change_nothing(distillers):
    """Five updates from the same rollouts at falling rates: two eager ones, then graphs."""
    captured, eager = distillers
    assert len(captured.rollouts) == 3
    for number in range(5):
        for distiller in distillers:
            distiller.set_rate(number / 5)
        captured.roll()
        eager.go_on()
        for value, source in zip(eager._of_rollout(), captured._of_rollout(), strict=True):
            value.copy_(source)
        for distiller in distillers:
            torch.manual_seed(number)  # of the gates' noise
            distiller.learn()
        torch.testing.assert_close(captured._losses, eager._losses, rtol=1e-4, atol=1e-6)
        for rollout, source in zip(captured.rollouts, eager.rollouts, strict=True):
            for name, value in rollout.stack.parameters.items():
                torch.testing.assert_close(value, source.stack.parameters[name], rtol=1e-3, atol=1e-4)
            for name, value in rollout.stack.moments.items():
                torch.testing.assert_close(value, source.stack.moments[name], rtol=1e-9, atol=1e-12)
    assert captured._learned._graph is not None and eager._learned._graph is None


def test_the_host_never_waits(distillers):
    distiller, _ = distillers
    for _ in range(3):
        distiller.iterate()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for share in (0.4, 0.8):
            distiller.set_rate(share)
            distiller.roll()
            distiller.learn()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(torch.isfinite(torch.tensor(list(distiller.iterate().metrics.values()))))

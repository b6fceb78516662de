"""Policies as ONNX files: ONNX Runtime agrees with torch to 1e-5 for any number of environments."""

import json

import numpy as np
import onnxruntime
import pytest
import torch
from small_runs import small_learner

from tgdsl.rl.playing.policy import Policy, read_policy, write_onnx_policy
from tgdsl.rl.students.student import Architecture, Encoder, Grid, Student, acting
from tgdsl.rl.train.folder import run_origin

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
GRID = Grid(2, 7, (2, 3, 2), (0, 1, 2, 3, 4, -1, 5, -1, 6, -1, -1, -1))
ENCODERS = (
    (3, Encoder("mlp", (8,), 5)),
    (14, Encoder("lstm", (6,), 5)),
    (14, Encoder("cnn", (4, 3), 5, grid=GRID)),
    (14, Encoder("convrnn", (4,), 5, grid=GRID)),
)
BATCHES = (1, 7, 64)


def session_of(file):
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    return session, session.get_modelmeta().custom_metadata_map


def test_a_teachers_onnx_equals_its_torchscript(tmp_path):
    learner, loaded = small_learner(tmp_path, train__actor="[tactile_sensors, proprio]")
    for _ in range(2):
        learner.iterate()  # updates the normalisation
    card = learner.card(run_origin(loaded, learner.env, 0, {}, 1), 0.0, "tgdsl train task.yaml")
    learner.write_policy(card, tmp_path / "policy.pt")
    saved = read_policy(tmp_path / "policy.pt")
    session, texts = session_of(tmp_path / "policy.onnx")
    assert json.loads(texts["card.json"]) == card
    assert texts["taxels.csv"].count("\n") == 1 + sum(len(table) for table in learner.env.touch.taxels.values())
    for num in BATCHES:
        obs = {name: 3.0 * torch.randn((num, size)) for name, size in card["groups"].items()}
        expected = Policy(saved, card["groups"], num, len(card["joints"]))(obs)
        assert expected.abs().max() > 0.01
        (actions,) = session.run(["actions"], {"obs": torch.cat(list(obs.values()), dim=1).numpy()})
        np.testing.assert_allclose(actions, expected, atol=1e-5)


def test_a_student_with_every_encoder_carries_its_memory_from_step_to_step(tmp_path):
    torch.manual_seed(3)
    student = Student(Architecture(ENCODERS, (8,), 2, ((4,),), gates=(2, 7)))
    torch.nn.init.uniform_(student.gates.weight, -0.2, 0.2)
    student.mean.normal_()
    student.var.uniform_(0.1, 4.0)
    write_onnx_policy(acting(student), {"card.json": "{}"}, tmp_path / "student.onnx")
    session, _ = session_of(tmp_path / "student.onnx")
    assert [port.name for port in session.get_inputs()] == ["obs", "memory"]
    for num in BATCHES:
        memory = torch.zeros((num, student.memory))
        onnx_memory = memory.numpy().copy()
        for step in range(20):
            x = torch.randn((num, 45))
            with torch.no_grad():
                expected, _, memory = student(x, memory)
            actions, onnx_memory = session.run(None, {"obs": x.numpy(), "memory": onnx_memory})
            np.testing.assert_allclose(actions, expected, atol=1e-5)
            np.testing.assert_allclose(onnx_memory, memory, atol=1e-5)
            if step == 9:  # an episode begins in the first environment
                onnx_memory = onnx_memory.copy()
                memory[0], onnx_memory[0] = 0.0, 0.0

"""Stored grasps: found again for their scene, refused for others, drawn by environments of their variant."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from pincer_tasks import GRASPS, SENSORS, pincer_env, write_pincer

from tgdsl.errors import FileError, SimulationError, SpecError
from tgdsl.files import cache
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.grasps import sampling as loading
from tgdsl.rl.grasps.grasps import Grasps, GraspTable, read_grasps, write_grasps
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import compile_sensors
from tgdsl.runtime.simulators.state_values import FIELDS
from tgdsl.scene.scene import scene_digest

BY_HAND = Grasps(
    qpos=np.arange(50.0).reshape(5, 10),
    ctrl=np.arange(15.0).reshape(5, 3),
    variant=np.array([1, 0, 1, 0, 1]),
    scene="a" * 64,
    object="rod",
    settings="{}",
)


@pytest.fixture
def separate_cache(tmp_path, monkeypatch):
    """Use a separate cache for this test."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def forbid_sampling(monkeypatch):
    """Return a function after whose call sampling fails the test."""

    def forbid():
        monkeypatch.setattr(loading, "sample", lambda *_: pytest.fail("sampled again"))

    return forbid


def digest_of(document, **overrides):
    loaded = load_task(document, overrides)
    return scene_digest(compile_sensors(loaded, "cpu").touch.plan.scene)


def refusal(call):
    """Return the only problem reported by a call that must fail."""
    with pytest.raises(SpecError) as caught:
        call()
    (problem,) = caught.value.problems
    return problem


def test_a_file_round_trips(tmp_path):
    file = tmp_path / "a folder" / "größe 1.npz"
    write_grasps(BY_HAND, file)
    grasps = read_grasps(file, "a" * 64, "rod")
    for name in ("qpos", "ctrl", "variant"):
        assert np.array_equal(getattr(grasps, name), getattr(BY_HAND, name))
    assert (grasps.scene, grasps.object, grasps.settings) == (BY_HAND.scene, "rod", "{}") and len(grasps) == 5
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_mismatched_files_are_refused(tmp_path):
    file = tmp_path / "grasps.npz"
    write_grasps(BY_HAND, file)
    with pytest.raises(SimulationError, match=r"grasps of another scene .*sample them again with `tgdsl grasps`"):
        read_grasps(file, "b" * 64, "rod")
    with pytest.raises(SimulationError, match='grasps of the object "rod", expected "cube"'):
        read_grasps(file, "a" * 64, "cube")
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(SimulationError, match="expected a file that `tgdsl grasps --out` wrote"):
        read_grasps(file, "a" * 64, "rod")
    np.savez(file, qpos=np.zeros(3))
    with pytest.raises(SimulationError, match="wrote: 'format'"):
        read_grasps(file, "a" * 64, "rod")
    with pytest.raises(SimulationError, match=r"expected a file that .* wrote: .*No such file"):
        read_grasps(tmp_path / "nowhere.npz", "a" * 64, "rod")
    with pytest.raises(FileError):
        write_grasps(BY_HAND, tmp_path)


def test_the_digest_depends_on_the_scene_but_not_on_touch(tmp_path):
    document = write_pincer(tmp_path)
    original = digest_of(document)
    assert digest_of(document, touch="force_taxel") == digest_of(document, touch="bool", placement="tips") == original
    scene = tmp_path / "scene.xml"
    text = scene.read_text()
    scene.write_text(text.replace("</worldbody>", "<!-- nothing --></worldbody>"))
    assert digest_of(document) == original
    for old, new in (('friction="1.0 ', 'friction="0.9 '), ("0.2  0 0 0.1", "0.2  0 0 0.11")):
        scene.write_text(text.replace(old, new))
        assert scene.read_text() != text and digest_of(document) != original
    scene.write_text(text)
    sensors = tmp_path / "sensors.yaml"
    sensors.write_text(SENSORS.replace("density: 600", "density: 601"))
    assert digest_of(document) != original
    sensors.write_text(SENSORS)
    robot = tmp_path / "pincer.xml"
    robot.write_text(robot.read_text().replace('damping="8"', 'damping="9"'))
    assert digest_of(document) != original


def test_the_digest_includes_the_scenes_sensors(tmp_path):
    document = write_pincer(tmp_path)
    original = digest_of(document)
    scene = tmp_path / "scene.xml"
    scene.write_text(scene.read_text().replace("</mujoco>", '<sensor><clock name="clock"/></sensor></mujoco>'))
    assert digest_of(document) not in (original, None)


def test_grasps_are_sampled_once(tmp_path, separate_cache, forbid_sampling):
    """Touch does not matter; other settings need other grasps."""
    messages = []
    document = write_pincer(tmp_path / "task")
    first = TouchEnv(document, 2, threads=1, progress=messages.append)
    assert messages.index("sampling grasps: 6 of 6") > 0 and len(cache.entries()) > 0
    forbid_sampling()
    second = TouchEnv(document, 3, threads=1, overrides={"touch": "bool", "rewards.spin": 3})
    assert torch.equal(first.task.grasps.qpos, second.task.grasps.qpos)
    for other in ({"grasps.seed": 1}, {"grasps.hold": "1 s"}, {"physics.substeps": 4}, {"joints": ["left"]}):
        with pytest.raises(pytest.fail.Exception, match="sampled again"):
            TouchEnv(document, 2, threads=1, overrides=other)


def test_a_damaged_cache_is_replaced(tmp_path, separate_cache):
    document = write_pincer(tmp_path / "task")
    first = TouchEnv(document, 2, threads=1)
    for entry in cache.entries():
        entry.file.write_bytes(b"nothing")
    second = TouchEnv(document, 2, threads=1)
    assert torch.equal(first.task.grasps.qpos, second.task.grasps.qpos)


def test_a_document_can_name_a_file_of_grasps(tmp_path, forbid_sampling):
    document = write_pincer(tmp_path)
    env = TouchEnv(document, 2, threads=1)
    table = env.task.grasps
    grasps = replace(BY_HAND, qpos=table.qpos.numpy(), ctrl=table.ctrl.numpy(), variant=np.array([0, 0, 0, 1, 1, 1]))
    digest = scene_digest(env.touch.plan.scene)
    write_grasps(replace(grasps, scene=digest), tmp_path / "own grasps.npz")
    forbid_sampling()
    overrides = {"grasps.file": "own grasps.npz"}
    other_env = TouchEnv(document, 2, threads=1, overrides={**overrides, "grasps.num": 4})
    assert torch.equal(other_env.task.grasps.qpos, table.qpos)
    document.write_text(document.read_text().replace("{num: 6", '{file: "own grasps.npz", num: 6'))
    write_grasps(grasps, tmp_path / "own grasps.npz")
    error = refusal(lambda: TouchEnv(document, 2, threads=1))
    assert (error.file, error.path, error.line) == (str(document), "grasps.file", 8)
    assert "grasps of another scene (aaaaaaaaaaaa, expected" in error.what
    write_grasps(replace(grasps, scene=digest, variant=np.ones(6, dtype=np.int64)), tmp_path / "own grasps.npz")
    assert "no grasps of variant 0 of rod" in refusal(lambda: TouchEnv(document, 2, threads=1)).what
    write_grasps(replace(grasps, scene=digest, qpos=grasps.qpos[:, :9]), tmp_path / "own grasps.npz")
    assert "grasps of 9 positions and 3 controls, expected 10 and 3" in refusal(lambda: TouchEnv(document, 2, threads=1)).what


def drawn_indices(env, num):
    """Return the indices of the grasps that environments draw, (episode, env)."""
    table, rows = env.task.grasps, []
    for episode in range(num):
        draw = table.draw(torch.full((env.num_envs,), episode))
        is_equal = (table.qpos[None] == torch.as_tensor(draw.values["qpos"])[:, None]).all(dim=2)
        assert (is_equal.sum(dim=1) == 1).all()
        indices = is_equal.int().argmax(dim=1)
        for stored, values in ((table.ctrl, draw.values["ctrl"]), (table.quat, draw.quat)):
            assert torch.equal(stored[indices], torch.as_tensor(values))
        for name, value in draw.contacts.items():
            assert torch.equal(table.contacts[name][indices], value)
        rows.append(indices)
    return torch.stack(rows)


def test_each_environment_draws_its_variants_grasps_equally_often(tmp_path):
    env = pincer_env(tmp_path, 4)
    indices = drawn_indices(env, 600)
    for column, variant in enumerate((0, 1, 0, 1)):
        counts = Counter(indices[:, column].tolist())
        assert set(counts) == {3 * variant, 3 * variant + 1, 3 * variant + 2}
        assert max(abs(num - 200) for num in counts.values()) < 5 * (600 * 2 / 9) ** 0.5
    assert not torch.equal(indices[:, 0], indices[:, 2])


def test_draws_do_not_depend_on_the_batch(tmp_path):
    """Four environments draw the same as two and two; another seed draws others."""
    whole, other = pincer_env(tmp_path, 4), pincer_env(tmp_path, 4, seed=1)
    halves = [TouchEnv(tmp_path / "task.yaml", 2, threads=1, first_env=first) for first in (0, 2)]
    expected = drawn_indices(whole, 20)
    assert torch.equal(torch.cat([drawn_indices(half, 20) for half in halves], dim=1), expected)
    assert not torch.equal(drawn_indices(other, 20), expected)


@pytest.mark.parametrize("touch", ["none", "bool", "force_taxel"])
@pytest.mark.parametrize("num_envs", [1, 5])
@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_stored_contacts_equal_the_simulations(tmp_path, touch, num_envs, simulator):
    """For each module's pairs and fields, in the simulator that steps them."""
    env = pincer_env(tmp_path, num_envs, overrides={"touch": touch}, simulator=simulator)
    table, sim = env.task.grasps, env.sim
    fields = {name for name in FIELDS if name in env.touch.inputs.fields}
    assert set(table.contacts) == fields and "contact_netforce" in fields
    episode = torch.arange(1, num_envs + 1)
    draw = table.draw(episode)
    sim.reset(contacts="evaluate", **draw.values)
    state, body = sim.state(), sim.watched().body("rod")
    for name in fields:
        torch.testing.assert_close(draw.contacts[name], getattr(state, name), rtol=0, atol=0)
    assert torch.equal(draw.quat, body.quat)


def test_episodes_begin_with_the_stored_grip(tmp_path):
    """Targets and forces, in the links' frames, are the stored ones, and the grip persists after a step."""
    env = pincer_env(tmp_path, 4, overrides={"touch": "force_taxel"})
    obs = env.reset(3)
    draw = env.task.grasps.draw(torch.full((4,), 1))
    assert torch.equal(env.sim.qpos, torch.as_tensor(draw.values["qpos"])) and not env.sim.qvel.any()
    assert torch.equal(env.actuation.target, torch.as_tensor(draw.values["ctrl"])[:, :2])
    force = draw.contacts["contact_netforce"].flatten(1).float()  # the jaws' axes are the world's
    torch.testing.assert_close(obs["priv_proprio"][:, 6:], force)
    assert (force[:, 0] < -0.5).all() and (obs["tactile_sensors"].abs().amax(dim=1) > 0.01).all()
    first_forces = obs["priv_proprio"][:, 6:]
    later_forces = env.step(torch.zeros(4, 2)).obs["priv_proprio"][:, 6:]
    torch.testing.assert_close(later_forces[:, [0, 3]], first_forces[:, [0, 3]], rtol=0.05, atol=0)


def test_other_tasks_need_no_grasps(tmp_path):
    document = write_pincer(tmp_path, grasps="")
    text = document.read_text().replace("task: screwdriver", "task: in_palm_rotate")
    document.write_text(text)
    env = TouchEnv(document, 2, threads=1)
    assert env.task.setup.grasps is None


def test_contacts_of_unused_variants_are_not_computed(tmp_path):
    env = pincer_env(tmp_path, 1)
    table = env.task.grasps
    assert isinstance(table, GraspTable)
    assert table.count.tolist() == [3] and len(table.qpos) == 6
    assert table.contacts["contact_netforce"][:3].any() and not table.contacts["contact_netforce"][3:].any()


def test_errors_in_settings_name_the_documents_keys(tmp_path):
    error = refusal(lambda: load_task(write_pincer(tmp_path, grasps=GRASPS.replace("yaw", "jaw"))))
    assert error.path == "grasps.jaw" and "yaw" in error.hint

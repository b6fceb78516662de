"""Grasps that are kept: found again where they belong, refused elsewhere, drawn by whom they were sampled for."""

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
from tgdsl.rl.sensed import compile_sensed
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
def own_cache(tmp_path, monkeypatch):
    """A cache of this test's own."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def not_sampled(monkeypatch):
    """Nothing may be sampled from now on."""

    def call():
        monkeypatch.setattr(loading, "sample", lambda *_: pytest.fail("sampled again"))

    return call


def digest_of(document, **overrides):
    loaded = load_task(document, overrides)
    return scene_digest(compile_sensed(loaded, "cpu").touch.plan.scene)


def refused(call):
    """Return the only mistake that a call is refused with."""
    with pytest.raises(SpecError) as caught:
        call()
    (found,) = caught.value.problems
    return found


def test_a_file_holds_what_was_written(tmp_path):
    file = tmp_path / "a folder" / "größe 1.npz"
    write_grasps(BY_HAND, file)
    found = read_grasps(file, "a" * 64, "rod")
    for name in ("qpos", "ctrl", "variant"):
        assert np.array_equal(getattr(found, name), getattr(BY_HAND, name))
    assert (found.scene, found.object, found.settings) == (BY_HAND.scene, "rod", "{}") and len(found) == 5
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_files_that_do_not_fit_are_refused(tmp_path):
    file = tmp_path / "grasps.npz"
    write_grasps(BY_HAND, file)
    with pytest.raises(SimulationError, match=r"grasps of another scene .*sample them again with `tgdsl grasps`"):
        read_grasps(file, "b" * 64, "rod")
    with pytest.raises(SimulationError, match='grasps of the object "rod", expected "cube"'):
        read_grasps(file, "a" * 64, "cube")
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(SimulationError, match="no grasps, expected a file that"):
        read_grasps(file, "a" * 64, "rod")
    np.savez(file, qpos=np.zeros(3))
    with pytest.raises(SimulationError, match="no grasps"):
        read_grasps(file, "a" * 64, "rod")
    with pytest.raises(SimulationError, match="cannot read this file: No such file"):
        read_grasps(tmp_path / "nowhere.npz", "a" * 64, "rod")
    with pytest.raises(FileError):
        write_grasps(BY_HAND, tmp_path)


def test_the_digest_is_of_the_scene_and_not_of_what_is_felt(tmp_path):
    document = write_pincer(tmp_path)
    plain = digest_of(document)
    assert digest_of(document, touch="force_taxel") == digest_of(document, touch="bool", placement="tips") == plain
    scene = tmp_path / "scene.xml"
    text = scene.read_text()
    scene.write_text(text.replace("</worldbody>", "<!-- nothing --></worldbody>"))
    assert digest_of(document) == plain
    for old, new in (('friction="1.0 ', 'friction="0.9 '), ("0.2  0 0 0.1", "0.2  0 0 0.11")):
        scene.write_text(text.replace(old, new))
        assert scene.read_text() != text and digest_of(document) != plain
    scene.write_text(text)
    sensors = tmp_path / "sensors.yaml"
    sensors.write_text(SENSORS.replace("density: 600", "density: 601"))
    assert digest_of(document) != plain
    sensors.write_text(SENSORS)
    robot = tmp_path / "pincer.xml"
    robot.write_text(robot.read_text().replace('damping="8"', 'damping="9"'))
    assert digest_of(document) != plain


def test_a_scenes_own_sensors_count(tmp_path):
    document = write_pincer(tmp_path)
    plain = digest_of(document)
    scene = tmp_path / "scene.xml"
    scene.write_text(scene.read_text().replace("</mujoco>", '<sensor><clock name="clock"/></sensor></mujoco>'))
    assert digest_of(document) not in (plain, None)


def test_they_are_sampled_once(tmp_path, own_cache, not_sampled):
    """Whatever is felt; other settings, other grasps."""
    told = []
    document = write_pincer(tmp_path / "task")
    first = TouchEnv(document, 2, threads=1, progress=told.append)
    assert told.index("sampling grasps: 6 of 6") > 0 and len(cache.entries()) > 0
    not_sampled()
    again = TouchEnv(document, 3, threads=1, overrides={"touch": "bool", "rewards.spin": 3})
    assert torch.equal(first.task.grasps.qpos, again.task.grasps.qpos)
    for other in ({"grasps.seed": 1}, {"grasps.hold": "1 s"}, {"physics.substeps": 4}, {"joints": ["left"]}):
        with pytest.raises(pytest.fail.Exception, match="sampled again"):
            TouchEnv(document, 2, threads=1, overrides=other)


def test_a_damaged_cache_is_sampled_anew(tmp_path, own_cache):
    document = write_pincer(tmp_path / "task")
    first = TouchEnv(document, 2, threads=1)
    for entry in cache.entries():
        entry.file.write_bytes(b"nothing")
    again = TouchEnv(document, 2, threads=1)
    assert torch.equal(first.task.grasps.qpos, again.task.grasps.qpos)


def test_a_document_may_name_a_file(tmp_path, not_sampled):
    document = write_pincer(tmp_path)
    env = TouchEnv(document, 2, threads=1)
    table = env.task.grasps
    grasps = replace(BY_HAND, qpos=table.qpos.numpy(), ctrl=table.ctrl.numpy(), variant=np.array([0, 0, 0, 1, 1, 1]))
    digest = scene_digest(env.touch.plan.scene)
    write_grasps(replace(grasps, scene=digest), tmp_path / "own grasps.npz")
    not_sampled()
    named = {"grasps.file": "own grasps.npz"}
    found = TouchEnv(document, 2, threads=1, overrides={**named, "grasps.num": 4})
    assert torch.equal(found.task.grasps.qpos, table.qpos)
    document.write_text(document.read_text().replace("{num: 6", '{file: "own grasps.npz", num: 6'))
    write_grasps(grasps, tmp_path / "own grasps.npz")
    error = refused(lambda: TouchEnv(document, 2, threads=1))
    assert (error.file, error.path, error.line) == (str(document), "grasps.file", 8)
    assert "grasps of another scene (aaaaaaaaaaaa, expected" in error.what
    write_grasps(replace(grasps, scene=digest, variant=np.ones(6, dtype=np.int64)), tmp_path / "own grasps.npz")
    assert "no grasps of variant 0 of rod" in refused(lambda: TouchEnv(document, 2, threads=1)).what
    write_grasps(replace(grasps, scene=digest, qpos=grasps.qpos[:, :9]), tmp_path / "own grasps.npz")
    assert "grasps of 9 positions and 3 controls, expected 10 and 3" in refused(lambda: TouchEnv(document, 2, threads=1)).what


def drawn(env, num):
    """Return which grasps environments draw in some episodes: (episode, env)."""
    table, found = env.task.grasps, []
    for episode in range(num):
        made = table.draw(torch.full((env.num_envs,), episode))
        same = (table.qpos[None] == torch.as_tensor(made.values["qpos"])[:, None]).all(dim=2)
        assert (same.sum(dim=1) == 1).all()
        which = same.int().argmax(dim=1)
        for own, values in ((table.ctrl, made.values["ctrl"]), (table.pos, made.pos), (table.quat, made.quat)):
            assert torch.equal(own[which], torch.as_tensor(values))
        for name, value in made.contacts.items():
            assert torch.equal(table.contacts[name][which], value)
        found.append(which)
    return torch.stack(found)


def test_each_environment_draws_grasps_of_its_own_variant_all_as_often(tmp_path):
    env = pincer_env(tmp_path, 4)
    which = drawn(env, 600)
    for column, variant in enumerate((0, 1, 0, 1)):
        counts = Counter(which[:, column].tolist())
        assert set(counts) == {3 * variant, 3 * variant + 1, 3 * variant + 2}
        assert max(abs(num - 200) for num in counts.values()) < 5 * (600 * 2 / 9) ** 0.5
    assert not torch.equal(which[:, 0], which[:, 2])


def test_draws_are_counted(tmp_path):
    """The same for four environments as for two and two, and another with another seed."""
    whole, other = pincer_env(tmp_path, 4), pincer_env(tmp_path, 4, seed=1)
    halves = [TouchEnv(tmp_path / "task.yaml", 2, threads=1, first_env=first) for first in (0, 2)]
    expected = drawn(whole, 20)
    assert torch.equal(torch.cat([drawn(half, 20) for half in halves], dim=1), expected)
    assert not torch.equal(drawn(other, 20), expected)


@pytest.mark.parametrize("touch", ["none", "bool", "force_taxel"])
@pytest.mark.parametrize("num_envs", [1, 5])
@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_contacts_are_those_that_the_simulation_finds_there(tmp_path, touch, num_envs, simulator):
    """By the pairs and fields of each module, in the simulator that will step them."""
    env = pincer_env(tmp_path, num_envs, overrides={"touch": touch}, simulator=simulator)
    table, sim = env.task.grasps, env.sim
    wanted = {name for name in FIELDS if name in env.touch.inputs.fields}
    assert set(table.contacts) == wanted and "contact_netforce" in wanted
    episode = torch.arange(1, num_envs + 1)
    made = table.draw(episode)
    sim.reset(contacts="evaluate", **made.values)
    state, body = sim.state(), sim.watched().body("rod")
    for name in wanted:
        torch.testing.assert_close(made.contacts[name], getattr(state, name), rtol=0, atol=0)
    assert torch.equal(made.pos, body.pos) and torch.equal(made.quat, body.quat)


def test_episodes_begin_as_the_hand_grips(tmp_path):
    """Targets are the stored controls, forces the stored ones, in the links' frames; the object stays where it is."""
    env = pincer_env(tmp_path, 4, overrides={"touch": "force_taxel"})
    obs = env.reset(3)
    made = env.task.grasps.draw(torch.full((4,), 1))
    assert torch.equal(env.sim.qpos, torch.as_tensor(made.values["qpos"])) and not env.sim.qvel.any()
    assert torch.equal(env.actuation.target, torch.as_tensor(made.values["ctrl"])[:, :2])
    force = made.contacts["contact_netforce"].flatten(1).float()  # the jaws' axes are the world's
    torch.testing.assert_close(obs["priv_proprio"][:, 6:], force)
    assert (force[:, 0] < -0.5).all() and (obs["tactile_sensors"].abs().amax(dim=1) > 0.01).all()
    before = obs["priv_proprio"][:, 6:]
    after = env.step(torch.zeros(4, 2)).obs["priv_proprio"][:, 6:]
    torch.testing.assert_close(after[:, [0, 3]], before[:, [0, 3]], rtol=0.05, atol=0)


def test_a_task_without_grasps_needs_none(tmp_path):
    document = write_pincer(tmp_path, grasps="")
    text = document.read_text().replace("task: screwdriver", "task: in_palm_rotate")
    document.write_text(text)
    env = TouchEnv(document, 2, threads=1)
    assert env.task.setup.grasps is None


def test_grasps_of_a_variant_that_no_environment_has_are_left_alone(tmp_path):
    env = pincer_env(tmp_path, 1)
    table = env.task.grasps
    assert isinstance(table, GraspTable)
    assert table.count.tolist() == [3] and len(table.qpos) == 6
    assert table.contacts["contact_netforce"][:3].any() and not table.contacts["contact_netforce"][3:].any()


def test_settings_are_told_in_the_documents_words(tmp_path):
    error = refused(lambda: load_task(write_pincer(tmp_path, grasps=GRASPS.replace("yaw", "jaw"))))
    assert error.path == "grasps.jaw" and "yaw" in error.hint

"""`tgdsl play` as users run it: output, files and errors."""

import mujoco
import numpy as np
import pytest
import torch
from small_tasks import STEPS, TASK, small_task

from tgdsl.rl.playing.record import PlayRecord

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


@pytest.fixture
def base(tmp_path):
    small_task(tmp_path)
    return tmp_path


@pytest.fixture
def without_opengl(monkeypatch):
    import tgdsl.rl.playing.video  # noqa: F401  # its annotations are of the renderer that there is

    def renderer(*_, **__):
        raise mujoco.FatalError("gladLoadGL error")

    monkeypatch.setattr(mujoco, "Renderer", renderer)


@pytest.fixture
def fails(here, base):
    """Return a function that runs a wrong command and returns its message; it must write nothing."""

    def run(*arguments):
        files_before = sorted(base.rglob("*"))
        code, out, message = here(base, "play", *arguments)
        assert (code, out) == (2, ""), message
        assert sorted(base.rglob("*")) == files_before
        return message

    return run


def test_play_prints_means_and_writes_a_record(base, here, without_opengl):
    code, out, error = here(base, "play", "task.yaml", "--envs", "2", "--seconds", "0.3", "--actions", "random", "--out", "a b")
    assert code == 0, error
    lines = out.splitlines()
    assert lines[0] == "t = 0.30 s, 2 environments, 2 episodes ended"
    assert lines[1].split() == ["mean", "over", "environments", "so", "far", "ended"]
    columns = {line.split()[0]: line.split()[-2:] for line in lines[3:-2]}
    assert list(columns)[:4] == ["score", "return", "success", "spin"]
    assert lines[-2] == "record: a b/played.npz"
    assert lines[-1].startswith("no video: OpenGL cannot be started (FatalError: gladLoadGL error); without a display set ")
    with np.load(base / "a b" / "played.npz") as record:
        reward = record["reward"]
        assert record["qpos"].shape == (12, 2, 9) and record["obs:tactile_sensors"].shape == (12, 2, 4)
        assert record["action"].std() > 0.3
    assert columns["return"] == [f"{reward[STEPS:].sum(0).mean():.3g}", f"{reward[:STEPS].sum(0).mean():.3g}"]
    assert [path.name for path in (base / "a b").iterdir()] == ["played.npz"]


def test_the_video_shows_the_touch_that_the_policy_observes(base, here, monkeypatch):
    """Each frame draws the observation of its step; nothing is drawn for a policy without touch."""
    import tgdsl.rl.playing.video as module

    sensors = base / "sensors.yaml"
    sensors.write_text(sensors.read_text().replace("direction: [0, 0, -1]", "direction: [0, 0, 1]"))  # the side on the item
    traces = []
    monkeypatch.setattr(module, "video", lambda *arguments: traces.append(arguments[-1]))
    for touch in ("bool", "none"):
        arguments = ("task.yaml", "--envs", "2", "--seconds", "0.3", "--actions", "random", "--set", f"touch={touch}")
        code, _, error = here(base, "play", *arguments, "--out", touch)
        assert code == 0, error
    with np.load(base / "bool" / "played.npz") as record:
        bits = record["obs:tactile_sensors"][:, 0]
    assert bits.any() and not bits.all()
    np.testing.assert_array_equal(traces[0].values[1:], bits[1:])
    assert traces[1] is None


def test_one_episode_of_zero_actions_is_the_default(base, here):
    code, out, error = here(base, "play", "task.yaml", "--no-video", "--set", "rewards.tilt=0", "--set", "touch=none")
    assert code == 0, error
    assert out.startswith("t = 0.20 s, 16 environments, 16 episodes ended\n")
    assert out.endswith("record: out/played.npz\n")
    with np.load(base / "out" / "played.npz") as record:
        assert not record["action"].any() and not record["term:tilt"].any()
        assert "obs:tactile_sensors" not in record


def test_the_same_seed_gives_the_same_record(base, here):
    def played(seed):
        assert here(base, "play", "task.yaml", "--envs", "2", "--no-video", "--actions", "random", "--seed", seed)[0] == 0
        with np.load(base / "out" / "played.npz") as record:
            return dict(record)

    first, repeated, other_seed = played("3"), played("3"), played("4")
    for name, value in first.items():
        np.testing.assert_array_equal(repeated[name], value)
    assert not np.array_equal(other_seed["action"], first["action"]) and not np.array_equal(
        other_seed["qpos"][0], first["qpos"][0]
    )


def test_actions_of_a_policy_follow_its_observations(base, here):
    """The record holds the observations and actions of a linear policy."""

    class Linear(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(13, 2)

        def forward(self, obs: torch.Tensor) -> torch.Tensor:
            return self.layer(obs)

    policy = Linear()
    torch.jit.script(policy).save(str(base / "policy.pt"))
    arguments = ("task.yaml", "--policy", "policy.pt", "--groups", "goal", "proprio", "--envs", "2", "--no-video")
    code, _, error = here(base, "play", *arguments)
    assert code == 0, error
    with np.load(base / "out" / "played.npz") as record:
        obs = np.concatenate([record["obs:goal"], record["obs:proprio"]], axis=2)
        expected = policy(torch.from_numpy(obs)).detach()
        np.testing.assert_allclose(record["action"], expected, atol=1e-6)


def test_actions_can_come_from_a_function(base, here):
    (base / "act.py").write_text("def up(env, obs):\n    return 0.1 * env.steps[:, None].expand(-1, env.num_actions)\n")
    code, _, error = here(base, "play", "task.yaml", "--actions", "act.py:up", "--envs", "2", "--no-video")
    assert code == 0, error
    with np.load(base / "out" / "played.npz") as record:
        np.testing.assert_allclose(record["action"][:, 1, 1], 0.1 * np.arange(STEPS))


@pytest.mark.slow
def test_wrong_arguments_are_refused(base, fails):
    (base / "wrong.yaml").write_text(TASK.replace("in_palm_rotate", "in_palm_rotat").replace('"*"', '"*", "nose"'))
    (base / "act.py").write_text("def up(env, obs):\n    return obs['gaol']\n")
    (base / "text.pt").write_text("no module")
    (base / "file").write_text("")
    torch.jit.script(torch.nn.Linear(5, 2)).save(str(base / "five.pt"))
    torch.jit.script(torch.nn.Linear(17, 3)).save(str(base / "three.pt"))
    cases = {
        ("none.yaml",): "none.yaml: cannot read this file: No such file or directory\n1 mistake\n",
        ("wrong.yaml",): 'wrong.yaml:2:7: task: there is no task "in_palm_rotat"; did you mean "in_palm_rotate"?',
        ("task.yaml", "--set", "rewards.spn=3"): '--set rewards.spn=3: rewards.spn: unknown key "spn"; did you mean "spin"?',
        ("task.yaml", "--set", "touch"): "tgdsl: --set touch: expected KEY=VALUE",
        ("task.yaml", "--policy", "none.pt"): "tgdsl: none.pt: cannot read this file: No such file or directory\n",
        ("task.yaml", "--policy", "text.pt"): "tgdsl: text.pt: this is no TorchScript file, as rsl_rl's",
        ("task.yaml", "--policy", "five.pt"): (
            "tgdsl: five.pt: this policy takes 5 numbers, not proprio (6) + tactile_sensors (4) + goal (7) = 17; name its groups"
        ),
        ("task.yaml", "--policy", "three.pt"): (
            "tgdsl: three.pt: this policy returns actions (16, 3), expected (16, 2): joints are others\n"
        ),
        (
            "task.yaml",
            "--policy",
            "five.pt",
            "--groups",
            "goals",
        ): 'tgdsl: there is no group of observations "goals"; did you mean',
        ("task.yaml", "--groups", "goal"): "tgdsl: --groups belong to a policy; give one with --policy\n",
        (
            "task.yaml",
            "--policy",
            "five.pt",
            "--actions",
            "random",
        ): "tgdsl: --policy five.pt and --actions random: expected one of",
        (
            "task.yaml",
            "--actions",
            "zeros",
        ): 'tgdsl: there are no actions "zeros", expected zero, random, script or FILE.py:FUNCTION',
        ("task.yaml", "--actions", "act.py:down"): 'tgdsl: act.py: there is no function "down"; known functions: up\n',
        ("task.yaml", "--actions", "act.py:up"): "tgdsl: act.py:2: up: KeyError: 'gaol'\n",
        ("task.yaml", "--actions", "script"): 'tgdsl: the task "in_palm_rotate" has no script',
        ("task.yaml", "--seconds", "0"): "tgdsl: played for 0 s: expected more than 0 s\n",
        ("task.yaml", "--seconds", "1e12"): "tgdsl: records of 16 environments at 40000000000000 steps need about ",
        ("task.yaml", "--envs", "0"): "tgdsl: num_envs is 0, expected a whole number of at least 1\n",
        ("task.yaml", "--camera", "sid"): 'tgdsl: the scene has no camera "sid"; did you mean "side"?\n',
        ("task.yaml", "--out", "file"): "tgdsl: file/played.npz: {base}/file is a file, expected a folder\n",
    }
    for arguments, message in cases.items():
        assert fails(*arguments).startswith(message.format(base=base)), arguments


@pytest.mark.parametrize("where", ["stepping", "writing"])
def test_ctrl_c_leaves_no_partial_files(base, here, monkeypatch, where):
    (base / "out").mkdir()
    (base / "out" / "played.npz").write_bytes(b"before")

    def interrupted(*arguments, **_):
        if where == "writing":
            arguments[0].write(b"half")
        raise KeyboardInterrupt

    if where == "stepping":
        monkeypatch.setattr(PlayRecord, "add", interrupted)
    else:
        monkeypatch.setattr(np, "savez_compressed", interrupted)
    files_before = sorted(base.rglob("*"))
    code, _, error = here(base, "play", "task.yaml", "--no-video")
    assert (code, error.splitlines()[-1]) == (130, "interrupted")
    assert sorted(base.rglob("*")) == files_before
    assert (base / "out" / "played.npz").read_bytes() == b"before"

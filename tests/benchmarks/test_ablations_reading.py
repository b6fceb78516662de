"""`benchmarks/ablations_reading.py`: made-up readings that hold a force exactly, in noise, or not at all; and a real teacher."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from ablations_page import tables
from ablations_reading import Recorded, fitted, read, readings, record, write_readings

from tgdsl.errors import TgdslError
from tgdsl.rl.load import load_task

REPOSITORY = Path(__file__).parents[2]
VARIANTS, ENVS, INSTANTS = 2, 12, 200


@pytest.fixture
def recorded():
    """Numbers that sum to the force; the same beside noise of its own size; numbers that have nothing to do with it; nothing."""
    random = np.random.default_rng(0)
    env = np.repeat(np.arange(ENVS), INSTANTS)
    parts = random.uniform(1.0, 3.0, size=(ENVS * INSTANTS, 3))
    force = parts.sum(axis=1)
    noise = force.std() * random.standard_normal(len(force))
    x = {"exact": parts, "noisy": (force + noise)[:, None], "other": random.standard_normal((len(force), 4))}
    x |= {"still": np.ones((len(force), 2))}
    return Recorded(x, dict.fromkeys(x, 1), force, env, env)


def test_how_much_is_read_is_what_is_there(recorded):
    """With noise of variance σ² beside a signal of variance s², the best linear reading has R² = s²/(s² + σ²), here a half."""
    found = {own.type: own for own in readings(recorded, VARIANTS)}
    assert list(found)[:2] == ["exact", "noisy"]
    assert found["exact"].r2 == pytest.approx(1.0, abs=1e-6) and found["exact"].relative < 1e-3
    assert found["noisy"].r2 == pytest.approx(0.5, abs=0.05)
    assert found["noisy"].rms == pytest.approx(np.sqrt(0.5) * recorded.force.std(), rel=0.1)
    assert found["noisy"].r2_low < found["noisy"].r2 < found["noisy"].r2_high
    for name in ("other", "still"):
        assert found[name].r2 == pytest.approx(0.0, abs=0.01)
    spread = recorded.force - recorded.force.mean()
    assert found["still"].relative == pytest.approx(np.sqrt(np.mean((spread / recorded.force) ** 2)), rel=0.05)
    assert all((own.train_episodes, own.test_episodes, own.instants) == (8, 4, 800) for own in found.values())


def test_the_fit_is_that_of_ridge_regression():
    """Against the augmented least squares that it solves."""
    random = np.random.default_rng(1)
    x, y, ridge = random.standard_normal((50, 4)) * [1.0, 2.0, 10.0, 0.1], random.standard_normal(50), 0.3
    z = (x - x.mean(axis=0)) / np.sqrt(x.var(axis=0).reshape(2, 2).mean(axis=1)).repeat(2)
    rows = np.vstack([z, np.sqrt(ridge * len(x)) * np.eye(4)])
    weights = np.linalg.lstsq(rows, np.concatenate([y - y.mean(), np.zeros(4)]), rcond=None)[0]
    np.testing.assert_allclose(read(x, fitted(x, y, ridge, channels=2)), z @ weights + y.mean(), rtol=0, atol=1e-12)


def test_what_is_written_is_what_the_page_shows(recorded, tmp_path):
    found = readings(recorded, VARIANTS)
    write_readings(found, tmp_path / "grip_force_reading.csv", ["reading", "--envs", "12"])
    text = tables(tmp_path)
    assert "`python benchmarks/ablations.py reading --envs 12`" in text and "8 episodes fit it, 4 others test it" in text
    with (tmp_path / "grip_force_reading.csv").open() as file:
        assert next(file).startswith("# python benchmarks/ablations.py reading")
        rows = list(csv.DictReader(file))
    assert [row["type"] for row in rows] == [own.type for own in found]
    assert "| `exact` | 3 | 1.000 (1.000 to 1.000) | 0.000 | 0.0 % (0.0 % to 0.0 %) |" in text


def test_a_taxel_that_is_hardly_ever_touched_gets_no_large_weight():
    """Its only touch in the fit is weak and by chance in a strong grip; one in earnest adds no more than any taxel's."""
    random = np.random.default_rng(2)
    x = np.column_stack([random.uniform(1.0, 3.0, 400), np.zeros(400)])
    y = x[:, 0].copy()
    x[7, 1], y[7] = 1e-3, 4.0
    fit = fitted(x, y, 1e-3)
    assert read(np.array([[2.0, 0.0]]), fit) == pytest.approx(2.0, abs=0.05)
    assert abs(read(np.array([[2.0, 1.0]]), fit) - 2.0) < 0.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_forces_that_match_the_load_are_read_and_bits_are_not():
    """The kept teacher in a few environments, and three of the types."""
    loaded = load_task(
        REPOSITORY / "examples" / "tasks" / "grip_force.yaml",
        {"variants": "[0, 5]", "starts": "[hold-0, hold-5]", "episode": "2 s"},
    )
    types = ("force_taxel", "agg_force", "bool")
    own = record(loaded, REPOSITORY / "policies" / "grip_force.pt", 18, 1, "hand", types=types)
    assert set(own.x) == {*types, "none"} and own.force.min() >= 0.5
    found = {each.type: each for each in readings(own, 2)}
    assert found["force_taxel"].r2 > 0.95 > 0.6 > found["bool"].r2 and found["force_taxel"].relative < 0.05
    with pytest.raises(
        TgdslError, match="3 environments, expected a multiple of 2, the variants of the object, and two of them"
    ):
        record(loaded, REPOSITORY / "policies" / "grip_force.pt", 3, 1, "hand")

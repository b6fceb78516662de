"""`benchmarks/ablations_reading.py`: made-up readings with an exact, noisy or absent force, and a real teacher."""

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
    """Return readings that sum to the force, the same with as much noise, unrelated ones, and constants."""
    random = np.random.default_rng(0)
    env = np.repeat(np.arange(ENVS), INSTANTS)
    parts = random.uniform(1.0, 3.0, size=(ENVS * INSTANTS, 3))
    force = parts.sum(axis=1)
    noise = force.std() * random.standard_normal(len(force))
    x = {"exact": parts, "noisy": (force + noise)[:, None], "other": random.standard_normal((len(force), 4))}
    x |= {"still": np.ones((len(force), 2))}
    return Recorded(x, dict.fromkeys(x, 1), force, env, env)


def test_r2_matches_the_signal_in_the_readings(recorded):
    """For a signal of variance s² with noise of variance σ², the best R² is s²/(s² + σ²), here a half."""
    by_type = {reading.type: reading for reading in readings(recorded, VARIANTS)}
    assert list(by_type)[:2] == ["exact", "noisy"]
    assert by_type["exact"].r2 == pytest.approx(1.0, abs=1e-6) and by_type["exact"].relative < 1e-3
    assert by_type["noisy"].r2 == pytest.approx(0.5, abs=0.05)
    assert by_type["noisy"].rms == pytest.approx(np.sqrt(0.5) * recorded.force.std(), rel=0.1)
    assert by_type["noisy"].r2_low < by_type["noisy"].r2 < by_type["noisy"].r2_high
    for name in ("other", "still"):
        assert by_type[name].r2 == pytest.approx(0.0, abs=0.01)
    spread = recorded.force - recorded.force.mean()
    assert by_type["still"].relative == pytest.approx(np.sqrt(np.mean((spread / recorded.force) ** 2)), rel=0.05)
    assert all((reading.train_episodes, reading.test_episodes, reading.instants) == (8, 4, 800) for reading in by_type.values())


def test_the_fit_is_ridge_regression():
    """It solves the augmented least squares."""
    random = np.random.default_rng(1)
    x, y, ridge = random.standard_normal((50, 4)) * [1.0, 2.0, 10.0, 0.1], random.standard_normal(50), 0.3
    z = (x - x.mean(axis=0)) / np.sqrt(x.var(axis=0).reshape(2, 2).mean(axis=1)).repeat(2)
    rows = np.vstack([z, np.sqrt(ridge * len(x)) * np.eye(4)])
    weights = np.linalg.lstsq(rows, np.concatenate([y - y.mean(), np.zeros(4)]), rcond=None)[0]
    np.testing.assert_allclose(read(x, fitted(x, y, ridge, channels=2)), z @ weights + y.mean(), rtol=0, atol=1e-12)


def test_the_page_shows_the_written_readings(recorded, tmp_path):
    results = readings(recorded, VARIANTS)
    write_readings(results, tmp_path / "grip_force_reading.csv", ["reading", "--envs", "12"])
    text = tables(tmp_path)
    assert "`python benchmarks/ablations.py reading --envs 12`" in text and "8 episodes fit it, 4 others test it" in text
    with (tmp_path / "grip_force_reading.csv").open() as file:
        assert next(file).startswith("# python benchmarks/ablations.py reading")
        rows = list(csv.DictReader(file))
    assert [row["type"] for row in rows] == [reading.type for reading in results]
    assert "| `exact` | 3 | 1.000 (1.000 to 1.000) | 0.000 | 0.0 % (0.0 % to 0.0 %) |" in text


def test_a_rarely_touched_taxel_gets_no_large_weight():
    """Its only touch in the fit is weak and coincides with a strong grip; a strong touch must add little."""
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
    """The repository's teacher in a few environments, and three of the types."""
    loaded = load_task(
        REPOSITORY / "examples" / "tasks" / "grip_force.yaml",
        {"variants": "[0, 5]", "starts": "[hold-0, hold-5]", "episode": "2 s"},
    )
    types = ("force_taxel", "agg_force", "bool")
    recording = record(loaded, REPOSITORY / "policies" / "grip_force.pt", 18, 1, "hand", types=types)
    assert set(recording.x) == {*types, "none"} and recording.force.min() >= 0.5
    by_type = {reading.type: reading for reading in readings(recording, 2)}
    assert by_type["force_taxel"].r2 > 0.95 > 0.6 > by_type["bool"].r2 and by_type["force_taxel"].relative < 0.05
    with pytest.raises(
        TgdslError, match="3 environments, expected a multiple of 2, the variants of the object, and two of them"
    ):
        record(loaded, REPOSITORY / "policies" / "grip_force.pt", 3, 1, "hand")

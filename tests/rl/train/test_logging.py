"""Progress shown during training."""

import pytest

from tgdsl.rl.train.run import ProgressBar


@pytest.mark.parametrize(("iterations", "begins"), [(6000, "38/6000: "), (None, "38: ")])
@pytest.mark.parametrize(("left", "shown"), [(119.7, "0:02:00 left"), (59.4, "0:00:59 left"), (3599.9, "1:00:00 left")])
def test_the_progress_line_shows_iterations_and_time_left(capsys, iterations, begins, left, shown):
    """In whole seconds; without a number of iterations, only the time."""
    bar = ProgressBar(iterations, 0, "turns")
    bar.show({"iteration": 38, "seconds": 20.0, "steps_per_second": 1234.5}, left)
    bar.close()
    assert capsys.readouterr().out == f"{begins}1,234 steps/s, {shown}\n"

"""What `make test-fast` leaves out is there."""

import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_test_that_is_listed_as_slow_exists():
    """By its file and its function's name, which a class may inherit."""
    listed = [line for line in (TESTS / "slow.txt").read_text().splitlines() if not line.startswith("#")]
    suite = (TESTS.parent / "tgdsl" / "testing" / "conformance.py").read_text()
    assert listed == sorted(set(listed)) and listed
    for name in listed:
        file, *_, function = name.split("::")
        text = (TESTS.parent / file).read_text()
        assert re.search(rf"def {function}\b", text) or re.search(rf"def {function}\b", suite), name

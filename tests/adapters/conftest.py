"""Adapters are tested against the simulators themselves, each in an environment of its own: `make test-adapters`."""

from importlib.util import find_spec

MISSING = [name for name in ("mjlab", "newton") if find_spec(name) is None]
collect_ignore = [f"test_{name}.py" for name in MISSING]


def pytest_report_header() -> list[str]:
    return [f"not installed, so not tested: {name} (make test-adapters)" for name in MISSING]

"""Adapters are tested with the real simulators, each in a separate environment: `make test-adapters`."""

from importlib.util import find_spec

NEEDS = {name: name for name in ("mjlab", "newton", "gymnasium_robotics", "genesis", "lerobot")} | {
    "isaaclab": "newton",
    "mjlab_tasks": "mjlab",
}
MISSING = sorted({host for host in NEEDS.values() if find_spec(host) is None})
collect_ignore = [f"test_{name}.py" for name, host in NEEDS.items() if host in MISSING]


def pytest_report_header() -> list[str]:
    return [f"not installed here, so not tested: {name}" for name in MISSING]

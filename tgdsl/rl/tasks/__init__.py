"""Tasks, one file each."""

TASKS: dict[str, tuple[str, str]] = {
    "in_palm_rotate": ("tgdsl.rl.tasks.in_palm_rotate", "InPalmRotate"),
}
"""The tasks of tgdsl by name: module and class."""

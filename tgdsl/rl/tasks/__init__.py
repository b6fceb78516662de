"""Tasks, one file each."""

TASKS: dict[str, tuple[str, str]] = {
    "in_palm_rotate": ("tgdsl.rl.tasks.in_palm_rotate", "InPalmRotate"),
    "grip_force": ("tgdsl.rl.tasks.grip_force", "GripForce"),
}
"""The tasks of tgdsl by name: module and class."""

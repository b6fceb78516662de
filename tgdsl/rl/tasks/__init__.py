"""Tasks, one file each."""

TASKS: dict[str, tuple[str, str]] = {
    "in_palm_rotate": ("tgdsl.rl.tasks.in_palm_rotate", "InPalmRotate"),
    "screwdriver": ("tgdsl.rl.tasks.screwdriver", "Screwdriver"),
}
"""The tasks of tgdsl by name: module and class."""

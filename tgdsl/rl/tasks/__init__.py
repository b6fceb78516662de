"""Tasks, one file each."""

TASKS = {
    "grip_force": "tgdsl.rl.tasks.grip_force:GripForce",
    "hot_ball": "tgdsl.rl.tasks.hot_ball:HotBall",
    "in_hand_repose": "tgdsl.rl.tasks.in_hand_repose:InHandRepose",
    "in_palm_rotate": "tgdsl.rl.tasks.in_palm_rotate:InPalmRotate",
    "screwdriver": "tgdsl.rl.tasks.screwdriver:Screwdriver",
}
"""The tasks of tgdsl by name: what a document would call them if they were a user's own."""

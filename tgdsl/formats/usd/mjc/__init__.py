"""What MuJoCo's and Newton's schemas for USD hold, as MJCF."""

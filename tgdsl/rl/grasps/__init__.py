"""Grasps that episodes begin from: sampled in simulation beforehand, kept in the user's cache, drawn at each reset."""

"""Initial grasps of episodes: sampled in simulation, cached, drawn at each reset."""

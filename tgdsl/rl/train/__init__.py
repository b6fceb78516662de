"""Learning by rsl_rl's PPO: captured on a GPU, written so that a run can go on, on one GPU or several."""

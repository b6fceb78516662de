"""Reinforcement learning on touch: environments, tasks, actuators and domain randomisation."""

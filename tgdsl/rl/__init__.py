"""Reinforcement learning on touch: environments, tasks, actuators and what is random about them."""

"""Where the taxels of a module are, as tables and images, and whether they are those of something else."""

"""What torch is told: dtypes, devices, buffers, where kernels stand in for operations, CUDA graphs, environments by index."""

"""Below all sensors: buffers, dtypes, devices, environment indices, CUDA graphs, operations with Triton kernels."""

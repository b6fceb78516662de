"""PyTorch parts: dtypes, devices, buffers, hints for Inductor, Triton dispatch, CUDA graphs, environment indices."""

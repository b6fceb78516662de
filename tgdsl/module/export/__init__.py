"""Modules out of Python: torch.export, AOTInductor and ONNX."""

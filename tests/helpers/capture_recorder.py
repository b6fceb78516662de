"""CUDA graphs of calls without a GPU: a replay runs the call again."""

import torch

from tgdsl.module.calls import WARM_CALLS


class Recorder:
    """Captures like a GPU: the call runs first, and a replay writes to the captured tensors."""

    def __init__(self):
        self.count = 0

    def __call__(self, call):
        self.count += 1
        for _ in range(WARM_CALLS):
            call()
        outputs = {name: torch.full_like(value, float("nan")) for name, value in call().items()}

        def replay():
            for name, value in call().items():
                outputs[name].copy_(value)

        return replay, outputs

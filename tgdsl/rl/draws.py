"""Random quantities of environments, counted and not drawn: each is a hash of what it is for.

A number depends on the seed, on what it is for, on its environment, counted over all processes, and on a count of that
environment's own, such as its episode. So it is the same on every device, in any batch, and whatever else is random.

The words are those of the sensors' noise: see `tgdsl.sensors.noise.random`.

Shapes: `env` environments, `num` numbers of one environment.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.sensors.noise.random import Stream, mix, normal_pair, sensor_key, uniform, words
from tgdsl.tensors.fused import FusedCall


class Draws:
    """The random numbers of some environments.

    Attributes:
        seed: What they follow from.
    """

    def __init__(
        self,
        seed: int,
        num_envs: int,
        device: torch.device | str = "cpu",
        first_env: int = 0,
        *,
        is_compiled: bool = False,
    ):
        """Begin.

        Args:
            seed: Another seed, other numbers.
            num_envs: Number of environments.
            device: Where the numbers are wanted.
            first_env: Number of the first environment, counted over all processes.
            is_compiled: Whether the hash, some fifty small operations, is compiled by torch.
        """
        self.seed, self._device = seed, torch.device(device)
        self._envs = torch.arange(first_env, first_env + num_envs, dtype=torch.int64, device=self._device)
        self._keys: dict[str, Int[Tensor, " half"]] = {}
        self._index: dict[int, Int[Tensor, " num"]] = {}
        self._words, self._shares = (FusedCall(m, is_compiled, has_fixed_shapes=False) for m in (self._hash, self._share))

    def reseed(self, seed: int) -> None:
        """Choose another seed, in place: graphs that were captured draw its numbers."""
        self.seed = seed
        for what, key in self._keys.items():
            key.copy_(torch.tensor(sensor_key(seed, what), dtype=torch.int32))

    def uniform(
        self, what: str, counter: Int[Tensor, " env"], num: int, low: float = 0.0, high: float = 1.0
    ) -> Float[Tensor, "env num"]:
        """Return numbers between two bounds, float32.

        Args:
            what: What they are for, such as "friction".
            counter: A count of each environment's own: other numbers at each count.
            num: How many each environment has.
            low: Lower bound.
            high: Upper bound.
        """
        return low + (high - low) * self._shares(*self._stream(what, num), counter)

    def normal(self, what: str, counter: Int[Tensor, " env"], num: int) -> Float[Tensor, "env num"]:
        """Return numbers of mean 0 and variance 1, float32: see `uniform`."""
        first, second = normal_pair(self._words(*self._stream(what, (num + 1) // 2), counter), torch.float32)
        return torch.cat([first, second], dim=1)[:, :num]

    def integers(self, what: str, counter: Int[Tensor, " env"], num: int, low: int, high: int) -> Int[Tensor, "env num"]:
        """Return whole numbers from `low` to `high`, both included: see `uniform`."""
        share = self._shares(*self._stream(what, num), counter)
        return low + (share * (high - low + 1)).to(torch.int64).clamp(max=high - low)

    def _stream(self, what: str, num: int) -> tuple[Int[Tensor, " half"], Int[Tensor, " num"]]:
        """Return the key of what numbers are for, and their places in the stream."""
        if what not in self._keys:  # at the first call: a graph that is captured later copies nothing from the host
            self._keys[what] = torch.tensor(sensor_key(self.seed, what), dtype=torch.int32, device=self._device)
        if num not in self._index:
            self._index[num] = torch.arange(num, dtype=torch.int32, device=self._device)
        return self._keys[what], self._index[num]

    def _share(
        self, key: Int[Tensor, " half"], index: Int[Tensor, " num"], counter: Int[Tensor, " env"]
    ) -> Float[Tensor, "env num"]:
        return uniform(self._hash(key, index, counter), torch.float32)

    def _hash(
        self, key: Int[Tensor, " half"], index: Int[Tensor, " num"], counter: Int[Tensor, " env"]
    ) -> Int[Tensor, "env num"]:
        low, high = counter.to(torch.int32)[:, None], mix((counter >> 32).to(torch.int32))[:, None]
        begun = mix(mix(mix(self._envs.to(torch.int32)[:, None] ^ key) ^ low) ^ high)
        return words(Stream(begun[:, :1], begun[:, 1:]), index)

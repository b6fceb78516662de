"""Counter-based random numbers of environments: each is a hash of its purpose and counters.

A number depends on the seed, its purpose, the environment's index across all processes, and a counter of that environment,
such as its episode. It is the same on every device, in any batch, and independent of all other random numbers.

The hash is the one of the sensors' noise: see `tgdsl.sensors.noise.random`.

Shapes: `env` environments, `num` numbers of one environment.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.sensors.noise.random import mix, mix_on_host, normal_pair, sensor_key, uniform, uniform_on_host
from tgdsl.tensors.env_ids import few_ids
from tgdsl.tensors.fused import FusedCall


class _Streams(NamedTuple):
    """Keys of several purposes' numbers: a hash per environment and purpose; each number's purpose and index in it."""

    begun: Int[Tensor, "env purpose half"]
    purpose: Int[Tensor, " num"]
    index: Int[Tensor, " num"]


class _Prefetched(NamedTuple):
    """Numbers hashed ahead of time: the counter of the first one left, and the numbers left."""

    counter: Int[Tensor, " env"]
    left: list[Float[Tensor, "env num"]]


class Draws:
    """The random numbers of some environments; they follow from `seed`."""

    def __init__(
        self, seed: int, num_envs: int, device: torch.device | str = "cpu", first_env: int = 0, *, is_compiled: bool = False
    ):
        """Begin; raise `SimulationError` if the seed has more than 64 bits. `first_env` is counted over all processes."""
        self.seed, self._device = _checked(seed), torch.device(device)
        self._envs = torch.arange(first_env, first_env + num_envs, dtype=torch.int64, device=self._device)
        self._is_on_host = self._device.type == "cpu" and not is_compiled
        self._known: dict[tuple[tuple[str, int], ...], _Streams] = {}
        self._ahead: dict[tuple[str, int], _Prefetched] = {}
        self._words = FusedCall(self._hash, is_compiled, has_fixed_shapes=False)
        self._shares = FusedCall(self._share, is_compiled, has_fixed_shapes=False)

    def reseed(self, seed: int) -> None:
        """Change the seed in place: captured graphs draw its numbers too."""
        self.seed = _checked(seed)
        self._ahead.clear()
        for sizes, streams in self._known.items():
            streams.begun.copy_(self._begun([purpose for purpose, _ in sizes]))

    def shares(
        self, sizes: Mapping[str, int], counter: Int[Tensor, " env"], chosen: Bool[Tensor, " env"] | None = None
    ) -> dict[str, Float[Tensor, "env num"]]:
        """Return numbers between 0 and 1 for several purposes: see `side_by_side`."""
        return dict(zip(sizes, self.side_by_side(sizes, counter, chosen).split(list(sizes.values()), dim=1), strict=True))

    def side_by_side(
        self, sizes: Mapping[str, int], counter: Int[Tensor, " env"], chosen: Bool[Tensor, " env"] | None
    ) -> Float[Tensor, "env num"]:
        """Return numbers between 0 and 1 for several purposes, concatenated, with as few operations as for one."""
        streams = self._streams(sizes)
        if not self._is_on_host:
            return self._shares(*streams, counter)
        begun, purpose, index, counts = (tensor.numpy() for tensor in (*streams, counter))
        rows = None if chosen is None else few_ids(chosen)
        if rows is None:
            return torch.from_numpy(uniform_on_host(_hash_on_host(begun, purpose, index, counts)))
        result, ids = np.zeros((len(counts), len(index)), dtype=np.float32), rows.numpy()
        result[ids] = uniform_on_host(_hash_on_host(begun[ids], purpose, index, counts[ids]))
        return torch.from_numpy(result)

    def shares_ahead(self, what: str, counter: Int[Tensor, " env"], num: int, ahead: int) -> Float[Tensor, "env num"]:
        """Return `shares` for a purpose whose counter rises by one with each call.

        On a CPU the numbers of `ahead` counts are hashed at once, and hashed again where the counter does not match.
        """
        if not self._is_on_host:
            return self.shares({what: num}, counter)[what]
        prefetched = self._ahead.get((what, num))
        if prefetched is None or not prefetched.left or not torch.equal(counter, prefetched.counter):
            begun, purpose, index, counts = (tensor.numpy() for tensor in (*self._streams({what: num}), counter))
            each = (counts[:, None] + np.arange(ahead)).ravel()
            numbers = uniform_on_host(_hash_on_host(begun.repeat(ahead, axis=0), purpose, index, each))
            numbers = numbers.reshape(len(counts), ahead, num).transpose(1, 0, 2)
            prefetched = _Prefetched(counter, list(torch.from_numpy(np.ascontiguousarray(numbers)).unbind()))
        self._ahead[what, num] = _Prefetched(counter + 1, prefetched.left[1:])
        return prefetched.left[0]

    def uniform(
        self, what: str, counter: Int[Tensor, " env"], num: int, low: float = 0.0, high: float = 1.0
    ) -> Float[Tensor, "env num"]:
        """Return numbers between two bounds, float32."""
        return within(self.shares({what: num}, counter)[what], low, high)

    def normal(self, what: str, counter: Int[Tensor, " env"], num: int) -> Float[Tensor, "env num"]:
        """Return numbers of mean 0 and variance 1, float32: see `uniform`."""
        first, second = normal_pair(self._words(*self._streams({what: (num + 1) // 2}), counter), torch.float32)
        return torch.cat([first, second], dim=1)[:, :num]

    def integers(self, what: str, counter: Int[Tensor, " env"], num: int, low: int, high: int) -> Int[Tensor, "env num"]:
        """Return whole numbers from `low` to `high`, both included: see `uniform`."""
        return whole(self.shares({what: num}, counter)[what], low, high)

    def _streams(self, sizes: Mapping[str, int]) -> _Streams:
        """Return the keys of some purposes' numbers."""
        requests = tuple(sizes.items())
        if requests not in self._known:  # at the first call: a graph that is captured later copies nothing from the host
            purpose = torch.tensor([i for i, (_, num) in enumerate(requests) for _ in range(num)], device=self._device)
            index = torch.tensor([i for _, num in requests for i in range(num)], dtype=torch.int32, device=self._device)
            self._known[requests] = _Streams(self._begun(list(sizes)), purpose, index)
        return self._known[requests]

    def _begun(self, names: list[str]) -> Int[Tensor, "env purpose half"]:
        keys = torch.tensor([sensor_key(self.seed, purpose) for purpose in names], dtype=torch.int32, device=self._device)
        return mix(self._envs.to(torch.int32)[:, None, None] ^ keys)

    def _share(self, *streams: Tensor) -> Float[Tensor, "env num"]:
        return uniform(self._hash(*streams), torch.float32)

    def _hash(
        self,
        begun: Int[Tensor, "env purpose half"],
        purpose: Int[Tensor, " num"],
        index: Int[Tensor, " num"],
        counter: Int[Tensor, " env"],
    ) -> Int[Tensor, "env num"]:
        if self._is_on_host:
            words = _hash_on_host(*(tensor.numpy() for tensor in (begun, purpose, index, counter)))
            return torch.from_numpy(words.view(np.int32))
        low, high = (half.to(torch.int32)[:, None, None] for half in (counter, counter >> 32))
        mixed = mix(torch.cat([begun ^ low, high.expand(-1, 1, 2)], dim=1))  # both at once
        first, second = mix(mixed[:, :-1] ^ mixed[:, -1:])[:, purpose].unbind(-1)
        return mix(index ^ first) ^ second


def _hash_on_host(
    begun: Int[np.ndarray, "env purpose half"],
    purpose: Int[np.ndarray, " num"],
    index: Int[np.ndarray, " num"],
    counter: Int[np.ndarray, " env"],
) -> UInt[np.ndarray, "env num"]:
    """Return the same words, uint32, by NumPy."""
    low, high = counter.astype(np.uint32)[:, None, None], (counter >> 32).astype(np.uint32)[:, None, None]
    keys = mix_on_host(mix_on_host(begun.view(np.uint32) ^ low) ^ mix_on_host(high))
    key = keys if keys.shape[1] == 1 else keys[:, purpose]
    word = mix_on_host(index.view(np.uint32) ^ key[:, :, 0])
    word ^= key[:, :, 1]
    return word


def within(share: Float[Tensor, "env num"], low: float, high: float) -> Float[Tensor, "env num"]:
    """Return shares, from 0 to 1, as numbers between two bounds."""
    return low + (high - low) * share


def whole(share: Float[Tensor, "env num"], low: int, high: int) -> Int[Tensor, "env num"]:
    """Return shares, from 0 to 1, as whole numbers from `low` to `high`, both included."""
    return low + (share * (high - low + 1)).to(torch.int64).clamp(max=high - low)


def _checked(seed: int) -> int:
    if not (isinstance(seed, Integral) and -(2**63) <= seed < 2**63):
        raise SimulationError(f"the seed is {seed!r}, expected a whole number of 64 bits: from −2⁶³ to 2⁶³ − 1")
    return seed

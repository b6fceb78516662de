"""Counter-based random numbers: each is a hash of its purpose and its number.

    word(k, i) = mix(i ⊕ k₀) ⊕ k₁                                  i-th 32-bit word of a stream (k₀, k₁)
    k_h = mix(mix(mix(environment ⊕ s_h) ⊕ counter) ⊕ c_h),   h = 0, 1

with mix a bijection of 32-bit words by shifts and products, (s₀, s₁) the sensor's key, and c_h the purpose with what the
counter has beyond 32 bits. The sensor's key comes from the seed and the sensor's name alone, the environment counts over all
processes. The counter is the step for numbers drawn at each reading, and the episode for numbers drawn at reset. So numbers do
not depend on other sensors, environments, batch size, device or process, and are neither stored nor drawn in order.

Uniform numbers have 23 bits, the same in float32 and float64. Normal ones come in pairs, each of one word (Box and Muller
1958): 20 bits for the radius, so that none is beyond √(2 ln 2²¹) = 5.40, and 12 for the angle.

Products are formed in int64 and cut to 32 bits, as overflow of int32 is undefined in C++.

Source of the constants of `mix`: the search for bijections of little bias that C. Wellons began ("Hash Prospector", 2018 on).

Shapes: `env` environments, `taxel` taxels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt
from torch import Tensor

from tgdsl.geometry.planes import pi
from tgdsl.tensors.fusion import materialised

READING, RADIUS, JITTER, GAIN, DEAD, PARAMETER, KIND = range(7)
"""Purposes of numbers: the first three are drawn at each step, the next three at reset, the last by a kind at each call."""

PER_STEP = (READING, RADIUS, JITTER)
UNIFORM_BITS, RADIUS_BITS, ANGLE_BITS = 23, 20, 10
"""Bits of a word that make a uniform number, and those for radius and angle within a quadrant of two normal ones."""
FACTORS = (0x21F0AAAD, 0x735A2D97)
SHIFTS = (16, 15, 15)
FIRST_PURPOSE, PURPOSE_STEP = 0x010DCD65, 0x0B873593
PURPOSES = tuple((FIRST_PURPOSE + PURPOSE_STEP * i) % 2**31 for i in range(14))
"""A constant for each purpose and half of a key: below 2³¹, as a compiler may form them by 32-bit index arithmetic."""


class Stream(NamedTuple):
    """A stream of 32-bit words for each environment: its two keys, int32 (env, 1)."""

    first: Tensor
    second: Tensor


def sensor_key(seed: int, sensor: str) -> tuple[int, int]:
    """Return the two int32 words that all streams of a sensor start from."""
    digest = hashlib.sha256(f"{seed}\0{sensor}".encode()).digest()
    return tuple(np.frombuffer(digest[:8], dtype="<i4").tolist())


def streams(
    keys: Int[Tensor, "sensor half"],
    env: Int[Tensor, " env"],
    step: Int[Tensor, " env"],
    episode: Int[Tensor, " env"],
) -> list[Mapping[int, Stream]]:
    """Return the streams of each sensor, by purpose.

    The number of operations does not grow with the number of sensors.

    Args:
        keys: The sensors' keys, int32.
        env: Numbers of the environments, int64, counted over all processes.
        step: Number of this reading of each environment, int64.
        episode: How often each environment was reset, int64.
    """
    counter = torch.stack([step, episode], dim=1)[:, None, :, None]
    low, high = counter.to(torch.int32), mix((counter >> 32).to(torch.int32))
    begun = mix(mix(env.to(torch.int32)[:, None, None] ^ keys)[:, :, None] ^ low)  # (env, sensor, counter, half)
    purposes = torch.arange(2 * KIND, device=env.device) * PURPOSE_STEP + FIRST_PURPOSE
    purposes = purposes.to(torch.int32).view(2, len(PER_STEP), 2)  # (counter, purpose, half)
    keys_by_purpose = materialised(mix((begun ^ high)[:, :, :, None] ^ purposes))  # once per environment, not once per taxel
    halves = [half.unbind(-1) for half in keys_by_purpose.flatten(2, 3).unbind(1)]
    return [{p: Stream(a[:, p, None], b[:, p, None]) for p in range(a.shape[1])} for a, b in halves]


def kind_stream(key: Int[Tensor, " half"], env: Int[Tensor, " env"], count: Int[Tensor, " env"]) -> Stream:
    """Return the stream that a sensor's kind draws from at one of its calls.

    Args:
        key: The sensor's key, int32.
        env: Numbers of the environments, int64, counted over all processes.
        count: Number of the call of each environment, int64; of the physics step for a block.
    """
    low, high = count[:, None].to(torch.int32), mix((count[:, None] >> 32).to(torch.int32))
    begun = mix(mix(env.to(torch.int32)[:, None] ^ key) ^ low) ^ high
    first, second = PURPOSES[2 * KIND :]
    return Stream(materialised(mix(begun[:, :1] ^ first)), materialised(mix(begun[:, 1:] ^ second)))


def words(stream: Stream, index: Int[Tensor, "*row"]) -> Int[Tensor, "*both"]:
    """Return the words with these numbers, int32; the stream's keys broadcast with them."""
    return mix(index ^ stream.first) ^ stream.second


def uniform(word: Int[Tensor, "*row taxel"], dtype: torch.dtype) -> Tensor:
    """Return numbers between 0 and 1, neither included: (k + 1/2) 2⁻²³, k the word's first bits."""
    return _share(word, UNIFORM_BITS, dtype)


def _share(word: Int[Tensor, "*row taxel"], num_bits: int, dtype: torch.dtype) -> Tensor:
    return ((word >> (32 - num_bits)) & (2**num_bits - 1)).to(dtype) * 2.0**-num_bits + 2.0 ** -(num_bits + 1)


def uniform_on_host(word: UInt[np.ndarray, "*row"]) -> Float[np.ndarray, "*row"]:
    """Return `uniform` of words, uint32, in NumPy: float32."""
    share = (word >> np.uint32(32 - UNIFORM_BITS)).astype(np.float32)
    share *= np.float32(2.0**-UNIFORM_BITS)
    share += np.float32(2.0 ** -(UNIFORM_BITS + 1))
    return share


def normal_pair(word: Int[Tensor, "*row taxel"], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return two independent normal numbers of mean 0 and variance 1.

    The angle is one of 2¹² at equal steps: ten bits for |b| < π/4, and two for the quadrant, which exchange sine and cosine and
    turn the cosine's sign. Both are their Taylor series there, to 3e-7.
    """
    share = _share(word, RADIUS_BITS, dtype)
    square = -2.0 * torch.log(share)
    radius = square * torch.rsqrt(torch.clamp(square, min=2.0**-30))  # in 8 bits a share may be 1
    part = ((word >> 2) & (2**ANGLE_BITS - 1)).to(dtype) - (2**ANGLE_BITS - 1) / 2
    angle = part * (pi() / 2 ** (ANGLE_BITS + 1))
    turn = angle * angle
    sine = angle * (1 + turn * (-1 / 6 + turn * (1 / 120 - turn * (1 / 5040))))
    cosine = 1 + turn * (-1 / 2 + turn * (1 / 24 + turn * (-1 / 720 + turn * (1 / 40320))))
    along = radius * cosine * (1 - (word & 2)).to(dtype)
    across = radius * sine
    is_turned = (word & 1) == 1
    return torch.where(is_turned, across, along), torch.where(is_turned, along, across)


def mix(word: Int[Tensor, "*row"]) -> Int[Tensor, "*row"]:
    """Return a bijection of 32-bit words, int32."""
    for shift, factor in zip(SHIFTS, (*FACTORS, None), strict=True):
        word = word ^ ((word >> shift) & ((1 << (32 - shift)) - 1))  # int32 shifts drag the sign along
        word = word if factor is None else (word.to(torch.int64) * factor).to(torch.int32)
    return word


def mix_on_host(word: UInt[np.ndarray, "*row"]) -> UInt[np.ndarray, "*row"]:
    """Return `mix` of words, uint32, in NumPy: of few words each of torch's operations takes some five times as long."""
    for shift, factor in zip(SHIFTS, (*FACTORS, None), strict=True):
        word = word ^ (word >> np.uint32(shift))
        if factor is not None:
            word *= np.uint32(factor)
    return word

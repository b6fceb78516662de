"""Repeated work on the same tensors: on a GPU it is captured as a CUDA graph at its third call."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar

import torch

from tgdsl.runtime.warp.stream import no_collection

T = TypeVar("T")
EAGER_CALLS = 2  # calls before the captured one: they load kernels and allocate persistent tensors


class Captured(Generic[T]):
    """A function without arguments that reads and writes the same tensors at each call; on a CPU just that function.

    Each call does the work once: the first two calls run eagerly on the stream of the later capture, so that libraries have
    their workspaces there; from the third on the graph is replayed. Its outputs are then always the same tensors.
    """

    def __init__(self, body: Callable[[], T], device: torch.device | str, has_tf32: bool = False, is_captured: bool = True):
        self._body, self._has_tf32, self._is_captured = body, has_tf32, is_captured
        self._stream = torch.cuda.Stream(device) if torch.device(device).type == "cuda" else None
        self.forget()

    def forget(self) -> None:
        """Discard the graph, as tensors have moved; the work is captured again."""
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._made: T | None = None

    def __call__(self) -> T:
        """Do the work."""
        if self._stream is None:
            with torch.inference_mode(False):
                return self._body()
        if not self._is_captured or (self._graph is None and self._calls < EAGER_CALLS):
            self._calls += 1
            return self._eager(self._stream)
        if self._graph is None:
            self._graph, self._made = self._capture(self._stream)
        self._graph.replay()
        return self._made  # pyright: ignore[reportReturnType]

    def _eager(self, stream: torch.cuda.Stream) -> T:
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream), _matmul(self._has_tf32), torch.inference_mode(False):
            outputs = self._body()
        current.wait_stream(stream)
        return outputs

    def _capture(self, stream: torch.cuda.Stream) -> tuple[torch.cuda.CUDAGraph, T]:
        """Capture the work without doing it."""
        graph = torch.cuda.CUDAGraph()
        gc.collect()
        with (
            no_collection(),
            _matmul(self._has_tf32),
            torch.inference_mode(False),
            torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
        ):
            outputs = self._body()
        return graph, outputs


class SideBySide:
    """Independent works: on a GPU each on a separate stream, on a CPU in turn.

    On a GPU their small kernels overlap. Within a `Captured` function they are parallel branches of its graph.
    """

    def __init__(self, count: int, device: torch.device | str):
        is_cuda = torch.device(device).type == "cuda"
        self._streams = [torch.cuda.Stream(device) for _ in range(count)] if is_cuda else None

    def __call__(self, works: Sequence[Callable[[], T]]) -> list[T]:
        """Run the works and return their results; work enqueued afterwards waits for all of them."""
        if self._streams is None:
            return [work() for work in works]
        outputs, current = [], torch.cuda.current_stream(self._streams[0].device)
        for stream, work in zip(self._streams[: len(works)], works, strict=True):
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                outputs.append(work())
        for stream in self._streams[: len(works)]:
            current.wait_stream(stream)
        return outputs


@contextlib.contextmanager
def _matmul(has_tf32: bool) -> Iterator[None]:
    """Multiply matrices in TF32 or in float32; restore the setting afterwards."""
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if has_tf32 else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(precision)

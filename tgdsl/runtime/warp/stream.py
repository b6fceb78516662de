"""The CUDA stream that Warp and torch share, and calls that are captured on it as CUDA graphs."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import torch

from tgdsl.errors import SimulationError
from tgdsl.runtime.simulators.machine import checked_device

T = TypeVar("T")
_EAGER_CALLS = 2  # calls before the one that is captured: they load kernels and make what lasts


def libraries() -> tuple[Any, Any]:
    """Return the modules `warp` and `mujoco_warp`."""
    try:
        import mujoco_warp
        import warp
    except ImportError as error:
        raise SimulationError('physics on a GPU needs MuJoCo Warp: pip install "tgdsl[gpu]"') from error
    return warp, mujoco_warp


class WarpStream:
    """A device, and on a GPU the stream that Warp and torch share there."""

    def __init__(self, device: str, graph: bool = True):
        self._warp = libraries()[0]
        self.device = checked_device(device, ("cuda", "cpu"))
        self.is_captured = graph and self.device.type == "cuda"
        with self._quiet():
            self._warp.init()
        self._stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._warp_stream = self._warp.stream_from_torch(self._stream) if self._stream else None
        self.is_in_own_graph = False  # whether the present work goes into a graph of `capture`

    @property
    def is_capturing(self) -> bool:
        """Whether torch is capturing a user's CUDA graph, which then includes the work directly."""
        return self.device.type == "cuda" and torch.cuda.is_current_stream_capturing()

    @contextlib.contextmanager
    def scope(self) -> Iterator[None]:
        """Queue Warp's and torch's work inside after all that torch has queued before, and before all that it queues later.

        Tensors made inside are ordinary ones without gradients, also under `inference_mode`: compiled code is the same in both.
        """
        with self._quiet(), self._warp.ScopedDevice(str(self.device)), torch.inference_mode(False), torch.no_grad():
            if self._stream is None:
                yield
                return
            self._stream.wait_stream(torch.cuda.current_stream(self.device))
            try:
                with torch.cuda.stream(self._stream), self._warp.ScopedStream(self._warp_stream):
                    yield
            finally:
                torch.cuda.current_stream(self.device).wait_stream(self._stream)

    @contextlib.contextmanager
    def capture_scope(self) -> Iterator[None]:
        """Put Warp's and torch's work inside into the graph that torch is capturing.

        Warp learns of the capture. It is on the stream where this has begun: only there can Warp put loops into a graph.
        """
        stream = self._warp.stream_from_torch(torch.cuda.current_stream(self.device))
        with (
            no_collection(),
            self._quiet(),
            torch.inference_mode(False),
            torch.no_grad(),
            self._warp.ScopedStream(stream, sync_enter=False),  # Warp's earlier work is in no graph
            self._warp.ScopedCapture(stream=stream, external=True),
        ):
            yield

    def capture(self, body: Callable[[], T]) -> tuple[torch.cuda.CUDAGraph, T]:
        """Capture work without doing it; return the graph, and what the body returned: tensors that a replay fills.

        torch owns the capture, which Warp joins.

        Raises:
            SimulationError: If the work cannot be captured.
        """
        graph = torch.cuda.CUDAGraph()
        with self.scope():
            gc.collect()
            self.is_in_own_graph = True
            try:
                with (
                    no_collection(),
                    torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"),
                    self._warp.ScopedCapture(stream=self._warp_stream, external=True),
                ):
                    result = body()
            except RuntimeError as error:
                raise SimulationError(f"this cannot be captured as a CUDA graph ({error}); set graph=False") from error
            finally:
                self.is_in_own_graph = False
        return graph, result

    def replay(self, graph: torch.cuda.CUDAGraph) -> None:
        """Replay a graph, after all that torch has queued before."""
        with torch.cuda.device(self.device):
            graph.replay()

    @contextlib.contextmanager
    def _quiet(self) -> Iterator[None]:
        """Keep Warp from announcing itself and the kernels that it loads."""
        log_level = self._warp.config.log_level
        self._warp.config.log_level = max(log_level, self._warp.LOG_ERROR)
        try:
            yield
        finally:
            self._warp.config.log_level = log_level


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keep garbage from being collected: to free one of Warp's arrays breaks a capture."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class GraphedCall(Generic[T]):
    """Work that is done again and again on the same arrays: on a GPU captured at its third call, and replayed from then on."""

    def __init__(self, stream: WarpStream, body: Callable[[], T]):
        self._stream, self._body = stream, body
        self.forget()

    def forget(self) -> None:
        """Drop the graph; later calls capture again."""
        self._eager_calls = 0
        self._captured: tuple[torch.cuda.CUDAGraph, T] | None = None

    @property
    def is_captured(self) -> bool:
        """Whether the work is replayed."""
        return self._captured is not None

    def __call__(self) -> T:
        """Do the work; tensors that a replay returns are the same each time."""
        if self._stream.is_in_own_graph:
            return self._body()
        if self._stream.is_capturing:
            with self._stream.capture_scope():
                return self._body()
        if not self._stream.is_captured or self._eager_calls < _EAGER_CALLS:
            self._eager_calls += 1
            with self._stream.scope():
                return self._body()
        if self._captured is None:
            self._captured = self._stream.capture(self._body)
        graph, result = self._captured
        self._stream.replay(graph)
        return result


def view(wp: Any, array: Any, device: torch.device) -> torch.Tensor:
    """Return torch's view of one of Warp's arrays; one without elements has no memory to view."""
    return wp.to_torch(array) if array.size else torch.empty(array.shape, device=device)

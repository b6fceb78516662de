"""Pictures and videos of the live page's 3-D view, as a browser draws it.

Shapes: `h` and `w` rows and columns of pixels.
"""

from __future__ import annotations

import threading
import time
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

Array = np.ndarray
RATE = 10.0  # frames per second of a video at most
LONGEST = 60.0  # how long a video is at most [s]
_ROWS = 400  # rows of pixels of a video
_PATIENCE = 20.0  # longest wait for one frame [s]


def view_of(client: Any, rows: int | None = None) -> UInt8[Array, "h w 3"]:
    """Return what a browser's camera sees, without the controls; default: as many pixels as the window has.

    Raises:
        TimeoutError: If the browser does not answer; viser raises another error where it is gone.
    """
    height, width = client.camera.image_height, client.camera.image_width
    size = (height, width) if rows is None else (rows, round(rows * width / height))
    return client.get_render(*size, transport_format="jpeg", timeout=_PATIENCE)[..., :3]


def png(image: UInt8[Array, "h w 3"]) -> bytes:
    """Return an image as a PNG file."""
    file = BytesIO()
    Image.fromarray(image).save(file, "PNG", optimize=True)
    return file.getvalue()


class Recording:
    """A video of a browser's view: a thread asks the browser for frames until `stop`, or for `LONGEST`."""

    def __init__(self, client: Any):
        self.client = client
        self._frames: list[tuple[float, Image.Image]] = []
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._record, daemon=True)
        self._thread.start()

    def stop(self) -> bytes | None:
        """Return the video as a GIF file that plays in real time; None if no frame has come."""
        self._is_over.set()
        self._thread.join()
        if not self._frames:
            return None
        times, images = zip(*self._frames, strict=True)
        durations = np.diff([*times, times[-1] + 1 / RATE]) * 1e3
        file = BytesIO()
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=durations.round().tolist(), loop=0)
        return file.getvalue()

    def _record(self) -> None:
        begin = time.monotonic()
        try:
            while not self._is_over.is_set() and time.monotonic() - begin < LONGEST:
                start = time.monotonic()
                image = Image.fromarray(view_of(self.client, _ROWS))
                self._frames.append((start, image.convert("P", palette=Image.Palette.ADAPTIVE)))
                self._is_over.wait(max(0.0, 1 / RATE - (time.monotonic() - start)))
        except (TimeoutError, RuntimeError):  # the browser is gone: the video ends here
            return

"""A browser, as far as the live page's server can see: it connects, and reads what it is sent."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (0, 0, 1),
    "fov": 1.0,
    "near": 0.01,
    "far": 10.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0, 0, 0),
    "up_direction": (0, 1, 0),
}
"""The message by which viser knows a browser."""


@contextmanager
def silent_browser(url: str) -> Iterator[None]:
    """Keep a page open."""

    def read_all() -> None:
        with suppress(ConnectionClosed):
            while True:
                socket.recv()

    with connect(url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        threading.Thread(target=read_all, daemon=True).start()
        yield

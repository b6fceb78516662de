"""Pictures and videos of a browser's view, of a client that draws as viser's do."""

import io
import time
from types import SimpleNamespace

import numpy as np
from PIL import Image

from tgdsl.view.capture import Recording, png, view_of


class Client:
    camera = SimpleNamespace(image_height=300, image_width=600)

    def __init__(self, num_frames: int = 1000):
        self.num_frames, self.sizes = num_frames, []

    def get_render(self, height, width, *, transport_format, timeout):
        if len(self.sizes) == self.num_frames:
            raise RuntimeError("the client disconnected")
        self.sizes.append((height, width))
        return np.full((height, width, 3), 10 * len(self.sizes) % 256, dtype=np.uint8)


def test_a_picture_has_the_pixels_of_the_window():
    client = Client()
    with Image.open(io.BytesIO(png(view_of(client)))) as image:
        assert image.size == (600, 300)
        assert image.getpixel((5, 5)) == (10, 10, 10)


def test_a_video_plays_as_long_as_it_was_recorded_and_ends_where_the_browser_goes():
    client = Client(num_frames=4)
    begin = time.monotonic()
    recording = Recording(client)
    recording._thread.join()
    recorded = time.monotonic() - begin
    video = recording.stop()
    assert video is not None
    with Image.open(io.BytesIO(video)) as frames:
        assert frames.size == (800, 400)
        assert frames.n_frames == 4
        duration = 0.0
        for i in range(4):
            frames.seek(i)
            duration += frames.info["duration"] / 1e3
            assert frames.convert("RGB").getpixel((5, 5)) == (10 * (i + 1),) * 3
    assert 0.3 < duration <= recorded + 0.15  # four frames, 0.1 s apart at least


def test_a_browser_that_is_gone_at_once_gives_no_video():
    assert Recording(Client(num_frames=0)).stop() is None

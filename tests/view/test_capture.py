"""What a browser saves: pictures, videos and frames, with a client that renders like viser's."""

import io
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import tgdsl
from tgdsl.view.page import Page, record, send_picture
from tgdsl.view.stages import SceneStage


class Client:
    camera = SimpleNamespace(image_height=300, image_width=600)

    def __init__(self, num_frames: int = 1000):
        self.num_frames, self.sizes, self.files = num_frames, [], []

    def get_render(self, height, width, *, transport_format, timeout):
        if len(self.sizes) == self.num_frames:
            raise RuntimeError("the client disconnected")
        self.sizes.append((height, width))
        return np.full((height, width, 3), 10 * len(self.sizes) % 256, dtype=np.uint8)

    def send_file_download(self, filename, content, *, save_immediately):
        assert save_immediately  # the browser shows no button to click
        self.files.append((filename, content))


def test_a_picture_has_the_size_of_the_window():
    client = Client()
    send_picture(client)
    ((name, content),) = client.files
    assert name == "view.png"
    with Image.open(io.BytesIO(content)) as image:
        assert image.size == (600, 300)
        assert image.getpixel((5, 5)) == (10, 10, 10)


def test_a_video_plays_in_real_time_and_ends_when_the_browser_disconnects():
    client = Client(num_frames=4)
    begin = time.monotonic()
    video = record(client, threading.Event())
    recorded = time.monotonic() - begin
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


def test_a_browser_that_disconnects_at_once_gives_no_video():
    assert record(Client(num_frames=0), threading.Event()) is None


def test_a_video_lasts_at_most_a_minute(monkeypatch):
    """By a clock that is read before and after each frame, and goes on by 7.5 s each time."""
    clock = iter(np.arange(0.0, 1e3, 7.5))
    monkeypatch.setattr("tgdsl.view.page.time", SimpleNamespace(monotonic=lambda: next(clock)))
    client = Client()
    record(client, threading.Event())
    assert len(client.sizes) == 4  # begun at 0, 15, 30 and 45 s


def test_a_video_ends_when_it_is_stopped():
    client, is_over = Client(), threading.Event()
    threading.Timer(0.3, is_over.set).start()
    video = record(client, is_over)
    assert video is not None
    with Image.open(io.BytesIO(video)) as frames:
        assert frames.n_frames == len(client.sizes) < 10


def test_buttons_act_for_the_browser_that_clicked(document, clicks):
    labels: list[str] = []  # of the video button, at each picture that the browser renders

    class Recorder(Client):
        def get_render(self, height, width, **options):
            labels.append(page.panel.record.label)
            if len(labels) == 4:
                clicks["video"](SimpleNamespace(client=self))  # a second click ends it
            return super().get_render(height, width, **options)

    client, stage = Recorder(), SceneStage(tgdsl.compile(document))
    page = Page(stage, port=8300)

    def click(label: str, value: str = "") -> None:
        clicks[label](SimpleNamespace(client=client, target=SimpleNamespace(value=value)))
        page.run(seconds=0.01)

    click("time", "step once")
    assert page.panel.paused.value and stage.time == pytest.approx(stage.control_step)
    click("save last minute")
    click("time", "restart")
    assert stage.time == 0
    click("screenshot")
    click("video")
    assert labels == ["record video", *["stop and save video"] * 3]
    assert page.panel.record.label == "record video"
    page.close()
    stage.close()
    files = dict(client.files)
    assert list(files) == ["seen.npz", "view.png", "view.gif"]
    with np.load(io.BytesIO(files["seen.npz"])) as frames:
        np.testing.assert_allclose(frames["time"], [0, stage.control_step])
    with Image.open(io.BytesIO(files["view.gif"])) as video:
        assert video.n_frames == 3  # the picture was the first of four

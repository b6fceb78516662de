"""`tgdsl listen`: files of a short run, and errors."""

import sys

import numpy as np
import pytest
import soundfile

from tgdsl.commands.documents import Listen
from tgdsl.console.bar import Bar
from tgdsl.errors import TgdslError

SCENE = """<mujoco><option timestep=".001"/><default><geom solref=".006 .5"/></default><worldbody>
  <body name="plate" pos="0 0 .05"><geom type="box" size=".1 .1 .05"/></body>
  <body name="ball" pos="0 0 .112"><freejoint/><geom size=".01" mass=".02"/></body>
  <body name="arm" pos=".3 0 .2"><joint name="hinge" axis="0 1 0"/><geom size=".02"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
DOCUMENT = """
tgdsl: 1
robot: {model: scene.xml}
objects: {ball: {body: ball}}
sensors:
  knock: {kind: contact_audio, links: plate, feels: [ball], samples: 20, substeps: 2, modes: [{frequency: 900, decay: 20}]}
  motors: {kind: actuation_audio, samples: 20, substeps: 2, hum_frequency: 300}
  ear: {kind: microphone, pos: [0, 0.5, 0.2]}
  touch: {kind: link_contact, links: plate, feels: [ball]}
"""


@pytest.fixture
def document(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "sound.yaml").write_text(DOCUMENT)
    return tmp_path / "sound.yaml"


@pytest.mark.slow
def test_a_run_is_written_as_files_and_a_picture(document, tmp_path, capsys):
    Listen(document, seconds=0.08, out=tmp_path / "out").run()
    output = capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "ear.wav",
        "knock.wav",
        "motors.wav",
        "spectrogram.png",
    ]
    for name in ("knock", "motors", "ear"):
        samples, rate = soundfile.read(tmp_path / "out" / f"{name}.wav")
        assert rate == 20000 and len(samples) == 1600 and np.abs(samples).max() == pytest.approx(0.7, abs=1e-3)
        assert f"{name}: {tmp_path / 'out' / name}.wav, 20000 Hz, full scale is " in output
    assert "spectrogram: " in output


def test_only_selected_sensors_are_written(document, tmp_path, monkeypatch):
    """The bar has counted all five calls, of two steps of 1 ms each."""
    counted, close = [], Bar.close
    monkeypatch.setattr(Bar, "close", lambda bar: counted.append((bar.n, bar.total)) or close(bar))
    Listen(document, ("ear",), seconds=0.01, out=tmp_path / "out").run()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["ear.wav", "spectrogram.png"]
    assert counted[0] == (5, 5)


@pytest.mark.parametrize(
    ("sensors", "overrides", "message"),
    [
        (("touch",), (), "--sensors touch: it makes no sound; known sensors that do: ear, knock, motors"),
        (
            (),
            ("sensors={touch: {kind: link_contact, links: plate, feels: [ball]}}",),
            "none of its sensors makes or hears sound",
        ),
    ],
)
def test_sensors_without_sound_are_refused(document, tmp_path, sensors, overrides, message):
    with pytest.raises(TgdslError, match=message):
        Listen(document, sensors, out=tmp_path / "out", set=overrides).run()
    assert not (tmp_path / "out").exists()


def test_without_soundfile_the_error_names_what_to_install(document, monkeypatch):
    monkeypatch.setitem(sys.modules, "soundfile", None)
    with pytest.raises(TgdslError, match=r'pip install "tgdsl\[sound\]"'):
        Listen(document).run()

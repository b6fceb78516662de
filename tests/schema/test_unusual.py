"""Values that were probably meant in another unit give one located warning; common values give none."""

import warnings
from pathlib import Path

import pytest
from documents import DOCUMENT, LAYOUT, POISSON, valid, write

from tgdsl.fields import units
from tgdsl.files.find import robots_folder
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.text import new_draft
from tgdsl.schema.load import load

CONTACT = "kind: contact"
TOUCH = "    feels: [ball]\n"
BALL = "ball: {body: ball}"
CASES = {
    "delay": (
        DOCUMENT.replace(TOUCH, TOUCH + "    noise: {read_delay: 20}\n"),
        '12:25: sensors.touch.noise.read_delay: found 20 s, usually at most 1 s; was "20 ms" or "20 µs" meant?',
    ),
    "a range of delays": (
        DOCUMENT.replace(TOUCH, TOUCH + "    noise: {read_delay: [0.01, 20 s]}\n"),
        '12:32: sensors.touch.noise.read_delay[1]: found 20 s, usually at most 1 s; was "20 ms" or "20 µs" meant?',
    ),
    "a profile": (
        DOCUMENT + "noise: {mine: {hysteresis: {strength: 1, time_constant: 1e4}}}\n",
        '12:57: noise.mine.hysteresis.time_constant: found 10000 s, usually at most 3600 s; was "10000 ms" or "10000 µs" meant?',
    ),
    "a sphere": (
        DOCUMENT.replace(BALL, "ball: {geom: {type: sphere, size: [15]}}"),
        '4:38: objects.ball.geom.size[0]: found 15 m, usually at most 5 m; was "15 cm" or "15 mm" meant?',
    ),
    "a variant": (
        DOCUMENT.replace(BALL, "ball: {variants: [{geoms: [{type: box, size: [1, 1, 60]}]}]}"),
        '4:55: objects.ball.variants[0].geoms[0].size[2]: found 60 m, usually at most 5 m; was "60 cm" or "60 mm" meant?',
    ),
    "a temperature in kelvin": (
        DOCUMENT.replace(BALL, "ball: {body: ball, material: steel, temperature: 318}"),
        '4:52: objects.ball.temperature: found 318 degC, usually at most 250 degC; was "318 K" meant?',
    ),
    "a temperature per environment": (
        DOCUMENT.replace(BALL, "ball: {body: ball, material: steel, temperature: {per_env: 318}}"),
        '4:62: objects.ball.temperature.per_env: found 318 degC, usually at most 250 degC; was "318 K" meant?',
    ),
    "a material": (
        DOCUMENT.replace(BALL, "ball: {body: ball, material: [steel, {like: wood, density: 0.7}]}"),
        '4:62: objects.ball.material[1].density: found 0.7 kg/m3, usually at least 5 kg/m3; was "0.7 g/cm3" meant?',
    ),
    "history": (
        DOCUMENT.replace(TOUCH, TOUCH + "    history: 100000\n"),
        "12:14: sensors.touch.history: found 100000, usually at most 1000",
    ),
    "rate": (
        DOCUMENT.replace(TOUCH, TOUCH + "    rate: 0.05\n"),
        '12:11: sensors.touch.rate: found 0.05 Hz, usually at least 0.1 Hz; was "0.05 kHz" meant?',
    ),
    "pressure": (
        DOCUMENT.replace(CONTACT, "kind: elastomer").replace(
            TOUCH,
            TOUCH + "    kernel: half_space\n    normal_stiffness: 1e8\n    youngs_modulus: 0.2\n",
        ),
        '14:21: sensors.touch.youngs_modulus: found 0.2 Pa, usually at least 1000 Pa; was "0.2 MPa" or "0.2 GPa" meant?',
    ),
    "a skin of plastic": (
        DOCUMENT.replace(CONTACT, "kind: elastomer").replace(
            TOUCH, TOUCH + "    kernel: half_space\n    normal_stiffness: 1e8\n    youngs_modulus: 1e9\n"
        ),
        "14:21: sensors.touch.youngs_modulus: found 1e+09 Pa, usually at most 5e+08 Pa",
    ),
    "the stiffness of a taxel": (
        DOCUMENT.replace(CONTACT, "kind: kinematic_taxel").replace(TOUCH, TOUCH + "    normal_stiffness: 1e9\n"),
        "12:23: sensors.touch.normal_stiffness: found 1e+09, usually at most 1e+07",
    ),
    "the stiffness of a skin": (
        DOCUMENT.replace(CONTACT, "kind: elastomer").replace(
            TOUCH, TOUCH + "    kernel: half_space\n    normal_stiffness: 1e17\n    youngs_modulus: 1e5\n"
        ),
        "13:23: sensors.touch.normal_stiffness: found 1e+17, usually at most 1e+12",
    ),
    "the stiffness of proximity": (
        DOCUMENT.replace(CONTACT, "kind: proximity").replace(TOUCH, TOUCH + "    normal_stiffness: 1e9\n"),
        "12:23: sensors.touch.normal_stiffness: found 1e+09, usually at most 1e+07",
    ),
}


def warned(path: Path) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(path).raise_problems()
    return [str(warning.message).replace(f"{path.parent}/", "") for warning in caught]


@pytest.mark.parametrize("case", CASES)
def test_an_unusual_value_gives_a_located_warning(tmp_path, case):
    document, message = CASES[case]
    assert warned(write(tmp_path, document)) == [f"hand.yaml:{message}"]


def test_unusual_values_in_layouts_are_located(tmp_path):
    text = LAYOUT.replace("radius: 2 mm", "radius: 2", 1)
    assert warned(write(tmp_path, layout=text)) == [
        'layout.yaml:5:52: resolutions.low.index_tip.radius: found 2 m, usually at most 0.1 m; was "2 cm" or "2 mm" meant?'
    ]
    text = LAYOUT.replace("radius: 2 mm", "radius: 2 mm, region: {facing: [0, 0, 1], within: 30}", 1)
    (message,) = warned(write(tmp_path, layout=text))
    assert message.endswith('.region.within: found 30 rad, usually at most 3.14159 rad; was "30 deg" meant?')
    inline = DOCUMENT.replace("layout.yaml", "{resolutions: {low: {a: " + POISSON.replace("2 mm", "200 mm") + "}}}")
    (message,) = warned(write(tmp_path, inline.replace("links: tips", "links: a")))
    assert (
        message.startswith("hand.yaml:2:")
        and ": robot.layout.resolutions.low.a.radius: found 0.2 m, usually at most" in message
    )


def test_included_documents_have_no_unusual_values():
    """Warnings are errors."""
    for path in sorted((robots_folder().parent / "examples").glob("*[!n].yaml")):
        load(path).raise_problems()
    for robot in ("xhand1", "sharpa"):
        load({"tgdsl": 1, "robot": {"model": robot}, "resolution": "med"}, needs_sensors=False).raise_problems()


def test_proposed_values_are_usual():
    for dimension, factors in units.UNITS.items():
        for value in (1e-9, 3e-4, 0.2, 15.0, 7e5):
            doubt = units.doubt(value, dimension, 1e-3, 2.0)
            assert (doubt is None) == (1e-3 <= value <= 2.0)
            for text in doubt[1].split('"')[1::2] if doubt else ():
                assert 1e-3 <= units.parse(text, dimension) <= 2.0, (dimension, text)
            if doubt and not doubt[1]:
                assert not any(1e-3 <= value * factor <= 2.0 for factor in factors.values())
    assert units.doubt(0.0, "length", 1.0, 2.0) is None
    assert units.doubt(-15.0, "length", 0.0, 2.0) == units.doubt(-15.0, "length", 0.0, 2.0) != None  # noqa: E711


def test_an_unusual_density_of_a_layout_warns(tmp_path):
    (tmp_path / "hand.xml").write_text(
        '<mujoco><worldbody><body name="palm"><geom type="box" size=".05 .05 .01"/></body></worldbody></mujoco>'
    )
    robot = load_model(tmp_path / "hand.xml")
    with pytest.warns(UserWarning, match="--density") as caught:
        new_draft(robot, "4", True, tmp_path / "one.yaml", False)
    assert str(caught[0].message) == '--density 4: found 4 /m2, usually at least 100 /m2; was "4 /cm2" or "4 /mm2" meant?'
    new_draft(robot, "4/cm2", True, tmp_path / "two.yaml", False)


def test_valid_documents_stay_quiet():
    load(valid())


@pytest.mark.parametrize(
    ("text", "dimension", "meant"),
    [
        ("4/cm^2", "density", "4/cm2"),
        ("4 /cm²", "density", "4 /cm2"),
        ("4 mm²", "area", "4 mm2"),
        (" 3 N·m", "torque", "3 N*m"),
        ("2 μm", "length", "2 µm"),
    ],
)
def test_other_spellings_of_units_get_a_hint(text, dimension, meant):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        units.parse(text, dimension)
    assert str(caught.value) == f'"{text}" is not a quantity; did you mean "{meant}"?'
    units.parse(meant, dimension)
    with pytest.raises(ValueError, match="expected"):
        units.parse("4^2", "number")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.05 mm", "expected a plain number: 5e-05, if m is meant"),
        ("60 deg", "expected a plain number: 1.0472, if rad is meant"),
        ("300 K", "expected a plain number: 26.85, if degC is meant"),
        ("2 pF", "expected a plain number"),
    ],
)
def test_a_unit_of_a_plain_number_is_refused(text, expected):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        units.parse(text, "number")
    assert str(caught.value) == f'"{text}" has a unit, {expected}'


@pytest.mark.parametrize(("text", "pascal"), [("0.2 MPa", 2e5), ("200kPa", 2e5), ("200000 Pa", 2e5), (2e5, 2e5)])
def test_pressures_are_converted(tmp_path, text, pascal):
    document = CASES["pressure"][0].replace("youngs_modulus: 0.2", f"youngs_modulus: {text}")
    (sensor,) = load(write(tmp_path, document)).spec.sensors.values()
    assert sensor.youngs_modulus == pytest.approx(pascal, rel=4e-16)  # type: ignore[attr-defined]

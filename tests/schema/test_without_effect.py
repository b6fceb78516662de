"""Fields without effect because of another field's value are refused at their location."""

import pytest

from tgdsl.errors import SpecError
from tgdsl.schema.load import load

CASES = {
    "settling of a force": (
        "kind: contact_audio, feels: [ball], modes: steel, model: force, settling: 5 ms",
        "`settling` has no effect with `model: force`; remove it",
    ),
    "settling of the paper": (
        "kind: contact_audio, feels: [ball], modes: steel, model: paper, settling: 5 ms",
        "`settling` has no effect with `model: paper`; remove it",
    ),
    "scale of samples": (
        "kind: contact_audio, feels: [ball], modes: steel, scale: decibel",
        "`scale` has no effect without `outputs: bands`; remove it",
    ),
    "points of a field": (
        "kind: proximity, feels: [ball], points: 100",
        "`points` has no effect with `backend: field`; remove it",
    ),
    "tolerance of points": (
        "kind: proximity, feels: [ball], backend: points, tolerance: 0.01",
        "`tolerance` has no effect with `backend: points`; remove it",
    ),
    "gradients of points": (
        "kind: proximity, feels: [ball], backend: points, gradient_tolerance: 0.01",
        "`gradient_tolerance` has no effect with `backend: points`; remove it",
    ),
    "torque that is not read": (
        "kind: proximity, feels: [ball], outputs: [force], torque_about: link",
        "`torque_about` has no effect without the output `torque`; remove it",
    ),
    "slip of torques about taxels": (
        "kind: proximity, feels: [ball], outputs: [torque], shear_damping: 5",
        "`shear_damping` has no effect on torque about the taxel; remove it",
    ),
    "threshold of a force": (
        "kind: link_contact, feels: [ball], outputs: [force], threshold: 0.1",
        "`threshold` has no effect without the output `contact`; remove it",
    ),
    "spin without torque": (
        "kind: kinematic_taxel, feels: [ball], outputs: [force], spin_damping: 1",
        "`spin_damping` has no effect without the output `torque`; remove it",
    ),
    "pitch of no whine": (
        "kind: actuation_audio, load: 0, power: 0, pitch: 50",
        "`pitch` has no effect without `load` or `power`; remove it",
    ),
    "frequency of no hum": (
        "kind: actuation_audio, hum: 0, hum_frequency: 50",
        "`hum_frequency` has no effect without `hum`; remove it",
    ),
    "scheme of the paper": (
        "kind: temperature_grid, cells: [2, 2, 2], material: skin, model: paper, scheme: exact",
        "`scheme` has no effect with `model: paper`; remove it",
    ),
    "film of the paper": (
        "kind: temperature_grid, feels: [ball], cells: [2, 2, 2], material: skin, model: paper, contact_conductance: 100",
        "`contact_conductance` has no effect with `model: paper`; remove it",
    ),
    "area without objects": (
        "kind: temperature_grid, cells: [2, 2, 2], material: skin, contact_area: 1 cm2",
        "`contact_area` has no effect without `feels`; remove it",
    ),
    "curvature of a given area": (
        "kind: temperature_grid, feels: [ball], cells: [2, 2, 2], material: skin, contact_area: 1 cm2, curvature_radius: 5 mm",
        "`curvature_radius` has no effect with a given `contact_area`; remove it",
    ),
    "faces that lose nothing": (
        "kind: temperature_grid, cells: [2, 2, 2], material: skin, exposed: [+z]",
        "`exposed` has no effect without `emissivity` or `convection`; remove it",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_field_without_effect_is_refused(tmp_path, case):
    fields, message = CASES[case]
    path = tmp_path / "touch.yaml"
    path.write_text(
        "tgdsl: 1\nrobot: {model: xhand1}\nobjects: {ball: {body: ball, material: steel}}\nsensors:\n"
        f"  felt: {{{'' if 'actuation' in fields else 'links: hand, '}{fields}}}\n"
    )
    with pytest.raises(SpecError) as caught:
        load(path)
    assert str(caught.value) == f"{path}:5:9: sensors.felt: {message}"

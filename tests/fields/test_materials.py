"""Materials against physics that their numbers must obey, and what a document may write for one."""

import dataclasses

import pytest
from pydantic import TypeAdapter, ValidationError

from tgdsl.fields.materials import MATERIALS, Material, MaterialField

FIELD = TypeAdapter(MaterialField)
METALS = ("steel", "stainless_steel", "aluminium", "anodized_aluminium", "copper", "brass")


@pytest.mark.parametrize("name", MATERIALS)
def test_numbers_are_possible(name):
    """Within what solids and liquids have: bounds of Ashby's charts; those of the bulk modulus E/3(1 − 2ν) ask for ν < 1/2."""
    found = MATERIALS[name]
    assert found.name == name
    assert found.source
    assert 0.02 < found.conductivity < 450
    assert 500 < found.density < 9000
    assert 0 < found.emissivity < 1
    assert 1e6 < found.density * found.specific_heat < 5e6, "volumetric heat capacities lie close together"
    assert (found.youngs_modulus is None) == (found.poissons_ratio is None)
    if found.youngs_modulus is not None and found.poissons_ratio is not None:
        assert 1e6 < found.youngs_modulus < 3e11
        assert 0 < found.poissons_ratio < 0.5


@pytest.mark.parametrize("name", METALS)
def test_metals_obey_dulong_and_petit(name):
    """3 R per mole within 10 %: 55.85 g/mol of iron (also of 18-8 steel, 55.3), 26.98 Al, 63.55 Cu, 64.1 of 70 Cu 30 Zn."""
    molar = {"stainless_steel": 55.3e-3, "steel": 55.85e-3, "copper": 63.55e-3, "brass": 64.1e-3}.get(name, 26.98e-3)
    assert MATERIALS[name].specific_heat * molar == pytest.approx(3 * 8.314, rel=0.1)


def test_by_name_with_changes_and_by_numbers():
    assert FIELD.validate_python("steel") is MATERIALS["steel"]
    assert FIELD.validate_python({"like": "steel"}) == MATERIALS["steel"]
    found = FIELD.validate_python(
        {"like": "steel", "conductivity": "15 W/(m*K)", "density": "7.8 g/cm3", "youngs_modulus": "200 GPa"}
    )
    own = {"conductivity": 15.0, "density": 7800.0, "youngs_modulus": 2e11}
    names = {"name": "like steel", "source": f"the document; {MATERIALS['steel'].source}"}
    assert found == dataclasses.replace(MATERIALS["steel"], **own, **names)
    numbers = {"conductivity": 0.2, "density": 1200, "specific_heat": "1.5 kJ/(kg*K)", "emissivity": 0.9}
    assert FIELD.validate_python(numbers) == Material("own", 0.2, 1200.0, 1500.0, 0.9, None, None, "the document")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("stel", 'unknown material "stel"; did you mean "steel"?'),
        ({"like": "stel"}, 'unknown material "stel"; did you mean "steel"?'),
        ({"density": 3}, "found no conductivity, specific_heat, emissivity; expected these, or `like`, the name of a material"),
        ({"like": "steel", "density": 0}, "0 is out of range, expected more than 0"),
        ({"like": "steel", "emissivity": 1.1}, "1.1 is out of range, expected at most 1"),
        ({"like": "steel", "poissons_ratio": 0.6}, "0.6 is out of range, expected at most 0.5"),
        ({"like": "steel", "density": "8 kg"}, '"kg" is not a unit of mass_density, expected one of kg/m3, g/cm3'),
    ],
)
def test_mistakes(value, message):
    with pytest.raises(ValidationError) as caught:
        FIELD.validate_python(value)
    (error,) = caught.value.errors()
    assert error["msg"] == f"Value error, {message}"

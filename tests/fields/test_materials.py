"""Materials against the physics that their numbers must obey, and their form in documents."""

import dataclasses
import math

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from tgdsl.fields.materials import MATERIALS, Material, MaterialField, rayleigh

FIELD = TypeAdapter(MaterialField)
METALS = ("steel", "stainless_steel", "aluminium", "anodized_aluminium", "copper", "brass")


@pytest.mark.parametrize("name", MATERIALS)
def test_numbers_are_plausible(name):
    """Within Ashby's bounds for solids and liquids; ν < 1/2 keeps the bulk modulus E/3(1 − 2ν) positive."""
    material = MATERIALS[name]
    assert material.name == name
    assert material.source
    assert 0.02 < material.conductivity < 450
    assert 500 < material.density < 9000
    assert 0 < material.emissivity < 1
    assert 1e6 < material.density * material.specific_heat < 5e6, "volumetric heat capacities lie close together"
    assert (material.youngs_modulus is None) == (material.poissons_ratio is None)
    if material.youngs_modulus is not None and material.poissons_ratio is not None:
        assert 1e6 < material.youngs_modulus < 3e11
        assert 0 < material.poissons_ratio < 0.5


@pytest.mark.parametrize("name", METALS)
def test_metals_obey_dulong_and_petit(name):
    """3 R per mole within 10 %: 55.85 g/mol for iron (18-8 steel: 55.3), 26.98 Al, 63.55 Cu, 64.1 for 70 Cu 30 Zn."""
    molar = {"stainless_steel": 55.3e-3, "steel": 55.85e-3, "copper": 63.55e-3, "brass": 64.1e-3}.get(name, 26.98e-3)
    assert MATERIALS[name].specific_heat * molar == pytest.approx(3 * 8.314, rel=0.1)


SPEEDS = {
    "steel": (5200, 3235),
    "stainless_steel": (5000, 3100),
    "aluminium": (5000, 3040),
    "anodized_aluminium": (5000, 3040),
    "copper": (3810, 2325),
    "brass": (3480, 2110),
    "glass": (5400, 3430),
}
"""Speed of sound along a thin rod and of shear waves [m/s]: CRC Handbook, 14-39; soda-lime glass: tables for ultrasonic tests."""


@pytest.mark.parametrize("name", SPEEDS)
def test_sound_is_as_fast_as_measured(name):
    """√(E/ρ) along a rod, √(G/ρ) in shear; alloys and glasses of one name differ by a few percent."""
    material = MATERIALS[name]
    rod, shear = SPEEDS[name]
    assert math.sqrt(material.youngs_modulus / material.density) == pytest.approx(rod, rel=0.05)
    assert math.sqrt(material.youngs_modulus / (2 * (1 + material.poissons_ratio)) / material.density) == pytest.approx(
        shear, rel=0.06
    )


@pytest.mark.parametrize(("name", "speed"), [("abs", 2230), ("pla", 2220)])
def test_sound_in_plastics_is_as_fast_as_measured(name, speed):
    """√(M/ρ) of plane waves, M = E (1 − ν)/((1 + ν)(1 − 2ν)): velocities for ultrasonic tests [m/s]."""
    material = MATERIALS[name]
    young, ratio = material.youngs_modulus, material.poissons_ratio
    modulus = young * (1 - ratio) / ((1 + ratio) * (1 - 2 * ratio))
    assert math.sqrt(modulus / material.density) == pytest.approx(speed, rel=0.12)


@pytest.mark.parametrize("name", ["rubber", "silicone"])
def test_rubbers_are_as_stiff_as_43_shore_and_nearly_incompressible(name):
    """Gent's relation between Young's modulus and Dow's hardness of Sylgard 184; soft natural rubber has a similar hardness."""
    hardness = 43.0
    gent = 1e6 * 0.0981 * (56 + 7.62336 * hardness) / (0.137505 * (254 - 2.54 * hardness))
    assert MATERIALS[name].youngs_modulus == pytest.approx(gent, rel=0.15)
    assert 0.49 < MATERIALS[name].poissons_ratio < 0.5


def test_wood_across_the_grain_matches_the_wood_handbook():
    """White oak: 12.3 GPa along the grain at 12 % moisture, 0.163 of it radially; ν_RT to ν_LR: 0.3 to 0.62."""
    assert MATERIALS["wood"].youngs_modulus == pytest.approx(0.163 * 12.3e9, rel=0.05)
    assert 0.25 < MATERIALS["wood"].poissons_ratio < 0.45


@pytest.mark.parametrize(
    ("name", "diffusivity"),
    [
        ("aluminium", 97.1),
        ("anodized_aluminium", 97.1),
        ("copper", 117),
        ("brass", 33.9),
        ("steel", 17.7),
        ("stainless_steel", 3.95),
    ],
)
def test_diffusivities_of_metals_match_measurements(name, diffusivity):
    """k/ρc [mm²/s], from a column in Incropera's table A.1."""
    material = MATERIALS[name]
    assert material.conductivity / (material.density * material.specific_heat) == pytest.approx(1e-6 * diffusivity, rel=0.01)


def test_water_has_its_prandtl_number():
    """μ c/k = 5.83 at 300 K, where μ = 855 µPa·s; c is a calorie per gram and kelvin; 996.5 kg/m³ at 300 K."""
    water = MATERIALS["water"]
    assert 855e-6 * water.specific_heat / water.conductivity == pytest.approx(5.83, rel=2e-3)
    assert water.specific_heat == pytest.approx(4184, rel=2e-3)
    assert water.density == pytest.approx(996.5, rel=1e-3)


RANGES = {
    "glass": ((0.75, 1.45), (2400, 2800), (600, 900)),
    "abs": ((0.13, 0.3), (1000, 1200), (1250, 1700)),
    "pla": ((0.11, 0.2), (1200, 1300), (1150, 1800)),
    "rubber": ((0.12, 0.2), (910, 1200), (1700, 2100)),
    "silicone": ((0.15, 0.3), (970, 1200), (1100, 1600)),
    "wood": ((0.15, 0.21), (540, 750), (1700, 2400)),
    "skin": ((0.3, 0.5), (1050, 1200), (3150, 3800)),
}
"""Conductivity, density and specific heat: ranges over makes in handbooks (CRC Handbook, Engineering ToolBox)."""


@pytest.mark.parametrize("name", RANGES)
def test_nonmetals_lie_within_handbook_ranges(name):
    material = MATERIALS[name]
    for value, (low, high) in zip((material.conductivity, material.density, material.specific_heat), RANGES[name], strict=True):
        assert low <= value <= high


EMISSIVITIES = {
    "glass": (0.9, 0.95),
    "steel": (0.1, 0.4),
    "stainless_steel": (0.1, 0.3),
    "aluminium": (0.039, 0.057),
    "anodized_aluminium": (0.77, 0.9),
    "copper": (0.023, 0.052),
    "brass": (0.028, 0.037),
    "abs": (0.9, 0.95),
    "pla": (0.9, 0.95),
    "rubber": (0.85, 0.95),
    "silicone": (0.85, 0.95),
    "wood": (0.8, 0.95),
    "skin": (0.95, 0.985),
    "water": (0.95, 0.96),
}
"""Engineering ToolBox, emissivity coefficients of common materials, metals polished; skin: Steketee 1973 (infrared)."""


@pytest.mark.parametrize("name", MATERIALS)
def test_emissivities_lie_within_handbook_ranges(name):
    low, high = EMISSIVITIES[name]
    assert low <= MATERIALS[name].emissivity <= high


DAMPING = {"glass": (1.0, 1e-7), "steel": (5.0, 3e-8), "stainless_steel": (5.0, 3e-8), "wood": (60.0, 2e-6)}
DAMPING |= {"abs": (30.0, 1e-6), "pla": (30.0, 1e-6)}
"""Jin et al.: α [1/s] and β [s] of their glass, steel, wood and plastic."""
LOSS = {"aluminium": 1e-4, "anodized_aluminium": 1e-4, "copper": 2e-3, "brass": 1e-3, "rubber": 0.1, "silicone": 0.1}
"""Cremer and Heckl's loss factors of metals, and twice the damping ratio 0.05 that Adams and Askenazi give for rubber."""


@pytest.mark.parametrize("name", MATERIALS)
def test_damping_matches_the_sources(name):
    """The loss factor 2d/ω = α/ω + β ω is least at 1 kHz, where both parts are equal: α = 1000 π η, β = η/(4000 π)."""
    expected = DAMPING.get(name, (None, None))
    if name in LOSS:
        expected = (1000 * math.pi * LOSS[name], LOSS[name] / (4000 * math.pi))
    material = MATERIALS[name]
    assert (material.mass_damping, material.stiffness_damping) == (
        expected if None in expected else pytest.approx(expected, rel=1e-12)
    )


def test_a_loss_factor_is_least_at_its_frequency():
    alpha, beta = rayleigh(0.02, 300.0)
    omega = 2 * math.pi * np.array([290.0, 300.0, 310.0])
    below, least, above = alpha / omega + beta * omega
    assert least == pytest.approx(0.02, rel=1e-12) and least < min(below, above)


def test_materials_by_name_with_changes_and_by_numbers():
    assert FIELD.validate_python("steel") is MATERIALS["steel"]
    assert FIELD.validate_python({"like": "steel"}) == MATERIALS["steel"]
    material = FIELD.validate_python(
        {"like": "steel", "conductivity": "15 W/(m*K)", "density": "7.8 g/cm3", "youngs_modulus": "200 GPa"}
    )
    changes = {"conductivity": 15.0, "density": 7800.0, "youngs_modulus": 2e11}
    names = {"name": "like steel", "source": f"the document; {MATERIALS['steel'].source}"}
    assert material == dataclasses.replace(MATERIALS["steel"], **changes, **names)
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

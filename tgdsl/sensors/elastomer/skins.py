"""Skins by name: values for the fields of an elastomer, which single fields may override.

`paper_gel` is what the experiments of Chung et al., *Tactile Genesis*, use (appendix, "ElastomerTaxel").

The others are elastic layers bonded to the link. Their Young's modulus follows from the hardness S (Shore A) by Gent's
relation,

    E = 0.0981 (56 + 7.62336 S)/(0.137505 (254 − 2.54 S))      [MPa]

(Gent, *Rubber Chemistry and Technology* 31, 1958, 896). It is rough: Ruess' log₁₀ E = 0.0235 S − 0.6403 gives 5 % less at 10
Shore A and 40 % more at 50. `soft_gel` is a silicone of 10 Shore A, as soft as those for skins and gel pads; `firm_rubber` is
one of 50 Shore A. Assumed are ν = 0.48 and a thickness of 2 mm: give your pad's own.

The normal stiffness, unless given, is of a layer that cannot spread sideways (Johnson, *Contact Mechanics*, 5.8),

    K_n = E (1 − ν)/((1 + ν)(1 − 2 ν) t)      [Pa/m]

for the Young's modulus, Poisson's ratio and thickness that the sensor then has; an incompressible layer has none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tgdsl.errors import did_you_mean
from tgdsl.fields import units


def young_of_shore(hardness: float) -> float:
    """Return Young's modulus of a rubber [Pa] by its hardness (Shore A): Gent's relation."""
    return 1e6 * 0.0981 * (56.0 + 7.62336 * hardness) / (0.137505 * (254.0 - 2.54 * hardness))


def _bonded(hardness: float) -> dict[str, Any]:
    young = float(f"{young_of_shore(hardness):.3g}")
    return {"kernel": "bonded_layer", "youngs_modulus": young, "poissons_ratio": 0.48, "thickness": 0.002}


SKINS: dict[str, dict[str, Any]] = {
    "paper_gel": {
        "kernel": "gaussian",
        "model": "paper",
        "dilation_strength": 100.0,
        "shear_strength": 100.0,
        "dilation_falloff": 8000.0,
        "shear_falloff": 2000.0,
        "depth_exponent": 1.2,
        "compressibility": 1.0,
        "enter": 1e-5,
        "exit": 1e-4,
    },
    "soft_gel": _bonded(10.0),
    "firm_rubber": _bonded(50.0),
}
"""Values of each, by field."""
OF_SHEAR = frozenset({"shear_falloff", "enter", "exit"})
"""Fields of a skin that are not used where a document turns shear off."""


def checked_skin(name: str | None) -> str | None:
    """Return a skin's name.

    Raises:
        ValueError: If there is none of that name.
    """
    if name is not None and name not in SKINS:
        raise ValueError(f'unknown skin "{name}"; {did_you_mean(name, SKINS, "skins")}')
    return name


def with_skin(fields: Mapping[str, Any], unused: Mapping[str, set[str]]) -> dict[str, Any]:
    """Return the fields of an elastomer, filled in from its skin.

    Args:
        fields: What a document says; its `like` names a skin.
        unused: Fields that each kernel does not use, which are left out of the skin's.

    Raises:
        ValueError: If the document asks for a kernel that the skin has no values for.
    """
    skin = SKINS[fields["like"]]
    kernel = fields.get("kernel", skin["kernel"])
    if not isinstance(kernel, str) or kernel not in unused:
        return dict(fields)  # which is reported where it stands
    if (kernel == "gaussian") != (skin["kernel"] == "gaussian"):
        fitting = " or ".join(name for name in unused if (name == "gaussian") == (skin["kernel"] == "gaussian"))
        raise ValueError(f'the skin "{fields["like"]}" has no values for the kernel {kernel}, expected {fitting}')
    left_out = unused[kernel] | (OF_SHEAR if fields.get("shear_strength") == 0 else set())
    merged = {name: value for name, value in skin.items() if name not in left_out} | dict(fields)
    if kernel != "gaussian" and "normal_stiffness" not in merged:
        stiffness = _layer_stiffness({**skin, **fields})
        merged |= {} if stiffness is None else {"normal_stiffness": stiffness}
    return merged


def _layer_stiffness(values: Mapping[str, Any]) -> float | None:
    """Return K_n; None if a value is none (which is reported where it stands), or there is no such layer."""
    try:
        young = units.parse(values.get("youngs_modulus"), "pressure")
        poisson = units.parse(values.get("poissons_ratio"), "number")
        thickness = units.parse(values.get("thickness"), "length")
    except ValueError:
        return None
    if not (young > 0 and thickness > 0 and -1 < poisson < 0.5):
        return None
    return young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson) * thickness)

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

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StrictInt, WithJsonSchema, model_validator

from tgdsl.errors import did_you_mean
from tgdsl.fields import units
from tgdsl.fields.models import (
    Area,
    NonNegative,
    Number,
    Positive,
    PositiveLength,
    Pressure,
    Quantity,
    Radius,
    SpecModel,
    Usual,
)
from tgdsl.fields.regions import Region
from tgdsl.sensors.base import ContactProbeSpec


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
OF_SHEAR = frozenset({"shear_falloff", "enter", "exit"})  # fields of a skin that are not used where a document turns shear off


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


def _is_fraction(value: float) -> float:
    if not 0.0 < value < 1.0:
        raise ValueError(f"{value:g} is out of range, expected more than 0 and less than 1")
    return value


class BoundarySpec(SpecModel):
    """An edge of the pad that cannot move in its plane."""

    pad: Region = ()
    """Part of each link's surface that is the pad: facing, box, sphere, geoms, or a list that means their intersection; empty:
    all of it."""
    drag: NonNegative = 3.0
    """β, drag of the bonded back [1]."""
    bulk: NonNegative = 0.0
    """K, resistance to in-plane compression [1]."""


class ElastomerSpec(ContactProbeSpec):
    """Displacement of the markers in a soft skin."""

    kind: Literal["elastomer"]
    """Displacement of the markers in a soft skin [m]."""
    like: Annotated[str | None, AfterValidator(checked_skin), WithJsonSchema({"enum": [*SKINS]})] = None
    """Skin that gives the default of each field: paper_gel, soft_gel or firm_rubber."""
    kernel: Literal["gaussian", "half_space", "bonded_layer"] = "gaussian"
    """How a load spreads: the paper's Gaussian, or an elastic half-space or layer bonded to a rigid base."""
    model: Literal["tgdsl", "paper"] = "tgdsl"
    """`paper` counts every taxel alike, whatever its area (gaussian)."""
    normalize: Literal["none", "peak"] = "none"
    """`peak` divides the in-plane dilation by the Gaussian's peak ḡ, as printed; s_d then has no unit (gaussian)."""
    dilation_strength: Number = 100.0
    """s_d, displacement per depth and distance [1/m] (gaussian)."""
    shear_strength: Number = 100.0
    """s_s, displacement per depth and shear [1/m] (gaussian); 0 turns shear off, for every kernel."""
    dilation_falloff: Positive = 8000.0
    """λ_d, falloff of the dilation [1/m²] (gaussian)."""
    shear_falloff: Positive = 2000.0
    """λ_s, falloff of the shear [1/m²] (gaussian)."""
    depth_exponent: Positive = 1.2
    """α, power of the depth in the bulge [1] (gaussian)."""
    compressibility: Annotated[float, Quantity("number", ge=0.0, le=1.0)] = 1.0
    """c, 1 for a local Gaussian spread, 0 for one that falls off as 1/r [1] (gaussian)."""
    reference_area: Annotated[Area, Usual("area", high=0.01)] = 6e-6
    """Area of a taxel that counts once [m²] (gaussian)."""
    thickness: Annotated[PositiveLength | None, Usual("length", high=0.1)] = None
    """Thickness of the elastomer [m] (gaussian: length ε, default the taxel spacing; bonded_layer)."""
    poissons_ratio: Annotated[float, Quantity("number", ge=0.0, le=0.5)] = 0.5
    """ν [1]; for the Gaussian it only sets the tangential against the normal stiffness under friction."""
    youngs_modulus: Annotated[Pressure | None, Usual("pressure", low=1e3, high=5e8)] = None
    """E [Pa], also as `0.2 MPa` (half_space, bonded_layer)."""
    normal_stiffness: Annotated[Positive | None, Usual("number", low=1e5, high=1e12)] = None
    """K_n, pressure per depth [Pa/m] (half_space, bonded_layer)."""
    marker_depth: Annotated[Radius, Usual("length", high=0.1)] = 0.0
    """Depth of the markers below the skin's surface [m] (half_space, bonded_layer)."""
    standoff: Annotated[Radius, Usual("length", high=0.1)] = 0.0
    """s, height of the undeformed skin above the taxels [m]. Above 0 it touches before the link does, and `gate` is
    `geometric`."""
    friction: NonNegative | None = None
    """μ, friction coefficient of the skin [1]; null: it never slides, as in the paper."""
    anchors: Literal["taxels", "points"] | None = None
    """What sticks: each taxel, to the object that it touches, or `points` sampled on each object, to the skin (the paper;
    gaussian). Default: `taxels`, or `points` with `model: paper`."""
    markers: str | None = None
    """Resolution of the layout whose taxels on the sensor's links are the markers that are read; the sensor's taxels are then
    the sources alone. Default: the taxels are the markers."""
    points: Annotated[StrictInt, Field(ge=1)] = 1000
    """Points of each object, for `anchors: points`."""
    enter: Annotated[Radius, Usual("length", high=0.1)] = 1e-5
    """Depth from which a taxel sticks to an object, or a point to the skin [m]."""
    exit: Annotated[Radius, Usual("length", high=0.1)] = 1e-4
    """Distance at which its anchor is released [m]."""
    boundary: BoundarySpec | None = None
    """An edge that is clamped, for the in-plane dilation (gaussian); needs `thickness`."""
    operator: Literal["auto", "dense", "fft", "svd"] = "auto"
    """How the fixed operator is applied; `auto` takes the cheapest that is exact, or within `tolerance` if that is given."""
    tolerance: Annotated[Positive, AfterValidator(_is_fraction)] | None = None
    """Relative error that a truncated operator may have [1]; svd: 1e-3 if not given."""

    @model_validator(mode="before")
    @classmethod
    def _upon_skin(cls, value: object, info: Any) -> object:
        """Fill in the fields of a skin; an error still finds the mapping that the document has."""
        if not isinstance(value, dict) or not isinstance(value.get("like"), str) or value["like"] not in SKINS:
            return value
        if isinstance(info.context, dict):
            info.context[id(value)] = cls
        return with_skin(value, UNUSED)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the skin that it is like came to, and which of its values are the sensor's own."""
        if self.like is None:
            return ()
        skin = SKINS[self.like]
        parts = []
        displayed = {*skin, "normal_stiffness"} & self.model_fields_set
        for name, field in type(self).model_fields.items():
            if name in displayed:
                value = getattr(self, name)
                unit = re.search(r"\[(.+?)\]", field.description or "")
                text = f"{value:g}" if isinstance(value, float) else str(value)
                text += f" {unit[1]}" if unit and unit[1] != "1" else ""
                parts.append(f"{name} {text}{' (own)' if name in skin and value != skin[name] else ''}")
        return (f"like {self.like}: {', '.join(parts)}",)

    @property
    def is_gated(self) -> bool:
        """Whether an object counts only while the simulator has it in contact with the taxel's link."""
        return super().is_gated and self.standoff == 0.0

    @property
    def has_shear(self) -> bool:
        """Whether shear is computed."""
        return self.shear_strength != 0.0

    @property
    def anchored(self) -> Literal["taxels", "points"] | None:
        """What sticks by an anchor; None without shear."""
        default = "points" if self.model == "paper" else "taxels"
        return (self.anchors or default) if self.has_shear else None

    @property
    def stiffness_ratio(self) -> float:
        """Tangential over normal stiffness K_t/K_n: of a layer by K_t = G/t, else Mindlin's of a contact, 2 (1 − ν)/(2 − ν)."""
        if self.kernel == "bonded_layer":
            assert self.youngs_modulus is not None and self.thickness is not None and self.normal_stiffness is not None
            return self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio) * self.thickness * self.normal_stiffness)
        return 2.0 * (1.0 - self.poissons_ratio) / (2.0 - self.poissons_ratio)

    @property
    def shear_stiffness(self) -> float:
        """K_t [Pa/m] of an elastic skin."""
        assert self.normal_stiffness is not None
        return self.normal_stiffness * self.stiffness_ratio

    @property
    def slip(self) -> float | None:
        """Largest tangential displacement per depth, μ K_n/K_t [1]; None if the skin never slides."""
        return None if self.friction is None else self.friction / self.stiffness_ratio

    @model_validator(mode="after")
    def _is_used(self) -> ElastomerSpec:
        for name in sorted(self.model_fields_set & UNUSED[self.kernel]):
            raise ValueError(f"`{name}` is not used by the kernel {self.kernel}, expected it to be left out")
        if self.kernel != "gaussian" and self.has_shear and "shear_strength" in self.model_fields_set:
            raise ValueError(f"`shear_strength` can only be 0, no shear, with the kernel {self.kernel}: K_t follows from K_n")
        if not self.has_shear:
            for name in sorted(self.model_fields_set & {"friction", "shear_falloff", "enter", "exit", "anchors", "points"}):
                raise ValueError(f"`{name}` is not used without shear (`shear_strength: 0`), expected it to be left out")
        if self.kernel != "gaussian" and self.anchors == "points":
            raise ValueError(f"`anchors: points` is for the kernel gaussian, expected `taxels` with the kernel {self.kernel}")
        if self.anchored == "taxels" and "points" in self.model_fields_set:
            raise ValueError("`points` is not used by `anchors: taxels`, expected it to be left out")
        for name in NEEDED[self.kernel]:
            if getattr(self, name) is None:
                raise ValueError(f"`{name}` is missing, the kernel {self.kernel} needs it")
        return self

    @model_validator(mode="after")
    def _fits(self) -> ElastomerSpec:
        if self.model == "paper" and "reference_area" in self.model_fields_set:
            raise ValueError("`reference_area` is not used by `model: paper`, expected it to be left out")
        if self.kernel == "bonded_layer" and self.thickness is not None and self.marker_depth > self.thickness:
            raise ValueError(
                f"`marker_depth` {self.marker_depth:g} m is below the layer, its `thickness` is {self.thickness:g} m"
            )
        if self.standoff > 0 and "gate" in self.model_fields_set and self.gate == "contact_pair":
            raise ValueError(
                "`gate: contact_pair` would hide what `standoff` feels before the link touches, expected `geometric`"
            )
        if self.boundary is not None and self.thickness is None:
            raise ValueError("`thickness` is missing, a clamped `boundary` needs it")
        if self.markers is not None and self.boundary is not None:
            raise ValueError("a clamped `boundary` is of markers that are the taxels, expected no `markers`")
        if self.markers is not None and self.operator == "fft":
            raise ValueError("`operator: fft` is of markers that are the taxels, expected dense, svd or auto with `markers`")
        if self.boundary is not None and self.operator == "fft":
            raise ValueError("`operator: fft` cannot hold a clamped `boundary`, expected dense, svd or auto")
        if self.tolerance is not None and self.operator in ("dense", "fft"):
            raise ValueError(f"`tolerance` is not used by `operator: {self.operator}`, expected it to be left out")
        return self


_GAUSSIAN = {"model", "normalize", "dilation_strength", "shear_falloff", "dilation_falloff", "depth_exponent", "reference_area"}
_GAUSSIAN |= {"compressibility", "boundary"}
UNUSED: dict[str, set[str]] = {
    "gaussian": {"youngs_modulus", "normal_stiffness", "marker_depth"},
    "half_space": _GAUSSIAN | {"thickness"},
    "bonded_layer": _GAUSSIAN,
}
"""Fields that each kernel does not use."""
NEEDED: dict[str, tuple[str, ...]] = {
    "gaussian": (),
    "half_space": ("youngs_modulus", "normal_stiffness"),
    "bonded_layer": ("youngs_modulus", "normal_stiffness", "thickness"),
}
"""Fields without a default that each kernel needs."""

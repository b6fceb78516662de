"""Wrong documents and layouts, each with the one line that is said about it."""

from documents import DOCUMENT

KNOBS = (
    "it has bias, dead_probability, dead_range, drift, gain, hysteresis, jitter, quantization, radius_noise, read_delay, "
    "release_threshold, white_noise"
)
KEYS = "known keys: noise, objects, observations, resolution, robot, scene, sensors, tgdsl"


def after(text: str) -> str:
    return DOCUMENT + text


def instead(old: str, new: str) -> str:
    assert DOCUMENT.count(old) == 1
    return DOCUMENT.replace(old, new)


WRONG = {
    "unknown key": (
        after("    tresholt: 1 mm\n"),
        'hand.yaml:12:5: sensors.touch.tresholt: unknown key "tresholt"; did you mean "threshold"?',
    ),
    "unknown key at the top": (after("bogus: 1\n"), f'hand.yaml:12:1: bogus: unknown key "bogus"; {KEYS}'),
    "unknown key named as the kind": (
        after("    contact: {links: 1}\n"),
        'hand.yaml:12:5: sensors.touch.contact: unknown key "contact"; known keys: '
        "accuracy, feels, gate, history, kind, links, noise, rate, readout, release_threshold, threshold",
    ),
    "unknown kind": (
        instead("kind: contact", "kind: contakt"),
        'hand.yaml:9:11: sensors.touch.kind: unknown kind "contakt"; did you mean "contact"?',
    ),
    "kind of another package": (
        instead("kind: contact", "kind: capacitance"),
        'hand.yaml:9:11: sensors.touch.kind: unknown kind "capacitance"; known kinds: actuation_audio, contact, contact_audio, '
        "contact_depth, elastomer, force_taxel, kinematic_taxel, link_contact, microphone, proximity, surface_distance, "
        "temperature_grid; kinds of other packages are known once these are installed",
    ),
    "misspelt kind": (
        instead("kind: contact", "knd: contact"),
        'hand.yaml:8:3: sensors.touch: missing key "kind"; is "knd" meant to be it?',
    ),
    "missing kind": (instead("kind: contact", "gate: geometric"), 'hand.yaml:8:3: sensors.touch: missing key "kind"'),
    "missing key": (instead("links: tips", "gate: geometric"), 'hand.yaml:8:3: sensors.touch: missing key "links"'),
    "missing layout": (
        instead("model: xhand1, layout: layout.yaml", "model: hand.xml"),
        'hand.yaml:2:1: robot: missing key "layout"; only robots given by name bring their own layout',
    ),
    "duplicate key": (
        after("    kind: contact\n"),
        "hand.yaml:12:5: sensors.touch.kind: this key stands twice, first in line 9",
    ),
    "unknown unit": (
        after("    threshold: 4 mn\n"),
        'hand.yaml:12:16: sensors.touch.threshold: "mn" is not a unit of length, expected one of m, cm, mm, um, µm',
    ),
    "out of range": (
        after("    threshold: -1 mm\n"),
        "hand.yaml:12:16: sensors.touch.threshold: -0.001 is out of range, expected at least 0",
    ),
    "huge number": (
        after(f"    threshold: {'9' * 400}\n"),
        'hand.yaml:12:16: sensors.touch.threshold: inf is not finite, expected a number in m or a string such as "4 µm"',
    ),
    "two keys at odds": (
        after("    threshold: 1 mm\n    release_threshold: 2 mm\n"),
        "hand.yaml:9:5: sensors.touch: release_threshold 0.002 m is above threshold 0.001 m, expected at most that",
    ),
    "no choice": (
        after("    gate: far\n"),
        "hand.yaml:12:11: sensors.touch.gate: found \"far\", expected 'contact_pair' or 'geometric'",
    ),
    "not a list": (instead("[ball]", "ball"), 'hand.yaml:11:12: sensors.touch.feels: found "ball", expected a list'),
    "empty list": (
        instead("[ball]", "[]"),
        "hand.yaml:11:12: sensors.touch.feels: found a list of 0, expected at least 1 entry",
    ),
    "not a string": (instead("[ball]", "[3]"), "hand.yaml:11:13: sensors.touch.feels[0]: found 3, expected a string"),
    "not a mapping": (instead("{body: ball}", "ball"), 'hand.yaml:4:9: objects.ball: found "ball", expected a mapping'),
    "nothing": (
        instead("{body: ball}", "{body: ball, surface: }"),
        "hand.yaml:4:30: objects.ball.surface: found nothing, expected a string",
    ),
    "an object that is nowhere": (
        instead("{body: ball}", "{}"),
        "hand.yaml:4:9: objects.ball: expected `body`, the name of a body in the scene, or `geom` or `variants` for an added body",
    ),
    "heat of nothing": (
        instead("{body: ball}", "{body: ball, temperature: 45}"),
        "hand.yaml:4:9: objects.ball: `temperature` is for heat flow, which needs `material`, such as `steel`",
    ),
    "heat of an unknown volume": (
        instead("{body: ball}", "{body: ball, material: steel, size: per_env}"),
        "hand.yaml:4:9: objects.ball: `material` with `size: per_env` is not supported: heat needs a volume known beforehand",
    ),
    "no temperature per environment": (
        instead("{body: ball}", "{body: ball, material: steel, temperature: per_env}"),
        "hand.yaml:4:52: objects.ball.temperature: found `per_env` alone, expected `{per_env: 45 degC}`, "
        "the temperature to begin with",
    ),
    "colder than cold": (
        instead("{body: ball}", "{body: ball, material: steel, temperature: -1 K}"),
        "hand.yaml:4:52: objects.ball.temperature: -274.15 is out of range, expected at least -273.15",
    ),
    "unknown material": (
        instead("{body: ball}", "{body: ball, material: [steel, stel]}"),
        'hand.yaml:4:40: objects.ball.material[1]: unknown material "stel"; did you mean "steel"?',
    ),
    "unknown material that it is like": (
        instead("{body: ball}", "{body: ball, material: {like: stel}}"),
        'hand.yaml:4:39: objects.ball.material.like: unknown material "stel"; did you mean "steel"?',
    ),
    "half a material": (
        instead("{body: ball}", "{body: ball, material: {density: 3 g/cm3}}"),
        "hand.yaml:4:32: objects.ball.material: found no conductivity, specific_heat, emissivity; expected these, or `like`, "
        "the name of a material",
    ),
    "no material": (
        instead("{body: ball}", "{body: ball, material: []}"),
        "hand.yaml:4:32: objects.ball.material: found a list of 0, expected at least 1 entry",
    ),
    "too many of a fraction": (
        instead("{body: ball}", "{body: ball, material: {like: steel, emissivity: 28}}"),
        "hand.yaml:4:58: objects.ball.material.emissivity: 28 is out of range, expected at most 1",
    ),
    "too few cells": (
        instead("{body: ball}", "{body: ball, material: steel, cells: [4, 4]}"),
        "hand.yaml:4:46: objects.ball.cells: found a list of 2, value 3 is missing",
    ),
    "no cells": (
        instead("{body: ball}", "{body: ball, material: steel, cells: [4, 4, 0]}"),
        "hand.yaml:4:53: objects.ball.cells[2]: found 0: input should be greater than or equal to 1",
    ),
    "not a selection": (
        instead("links: tips", "links: 3"),
        "hand.yaml:10:12: sensors.touch.links: not a selection, "
        "expected a name, a list of names, or {include: [...], exclude: [...]}",
    ),
    "not a name": (
        instead("  cube:", "  2d:"),
        'hand.yaml:5:3: objects.2d: "2d" is not a name, expected letters, digits, "_" and "-", first a letter or "_"',
    ),
    "too few values": (
        after("    noise: {gain: [1]}\n"),
        "hand.yaml:12:19: sensors.touch.noise.gain: found a list of 1, value 2 is missing",
    ),
    "too many values": (
        after("    noise: {gain: [1, 1, 1]}\n"),
        "hand.yaml:12:19: sensors.touch.noise.gain: found a list of 3, expected 2 entries",
    ),
    "unknown object": (
        instead("[ball]", "[cube, bal]"),
        'hand.yaml:11:19: sensors.touch.feels[1]: unknown object "bal"; did you mean "ball"?',
    ),
    "unknown sensor": (
        after("observations:\n  policy: [{type: bool, of: touch}, {type: bool, of: toch}]\n"),
        'hand.yaml:13:54: observations.policy[1].of: unknown sensor "toch"; did you mean "touch"?',
    ),
    "unknown observation": (
        after("observations:\n  policy:\n    - {type: boole, of: touch}\n"),
        'hand.yaml:14:14: observations.policy[0].type: unknown type "boole"; did you mean "bool"?',
    ),
    "unknown noise profile": (
        after("    noise: noise\n"),
        'hand.yaml:12:12: sensors.touch.noise: unknown noise profile "noise"; did you mean "noisy"?',
    ),
    "unknown resolution": (
        instead("resolution: low", "resolution: lo"),
        'hand.yaml:6:13: resolution: unknown resolution "lo"; did you mean "low"?',
    ),
    "no resolution": (
        instead("resolution: low\n", ""),
        'hand.yaml:1:1: missing key "resolution"; the layout has low, high',
    ),
    "resolution of another type": (
        instead("resolution: low", "resolution: 3"),
        "hand.yaml:6:13: resolution: found 3, expected a string",
    ),
    "knob in line": (
        after("    noise:\n      bias: 0\n      gain: [0.9, 1.1]\n      crosstalk: {strength: 0.1, sigma: 2 mm}\n"),
        f'hand.yaml:15:18: sensors.touch.noise.crosstalk: "contact" has no knob "crosstalk"; {KNOBS}',
    ),
    "knob of an own profile": (
        after("    noise: old\nnoise:\n  old: {crosstalk: {strength: 0.1, sigma: 2 mm}}\n"),
        f'hand.yaml:12:12: sensors.touch.noise: "contact" has no knob "crosstalk" (in the profile old → clean); {KNOBS}',
    ),
    "knob of some links": (
        after("    noise: {links: {index_tip: {crosstalk: {strength: 0.1, sigma: 2 mm}}}}\n"),
        f'hand.yaml:12:44: sensors.touch.noise.links.index_tip.crosstalk: "contact" has no knob "crosstalk"; {KNOBS}',
    ),
    "profiles in a circle": (
        after("    noise: {like: a}\nnoise:\n  a: {like: b}\n  b: {like: a}\n"),
        "hand.yaml:15:13: noise.b.like: noise profiles lead in a circle; a → b → a",
    ),
    "unknown profile to start from": (
        after("    noise: {like: nosy}\n"),
        'hand.yaml:12:19: sensors.touch.noise.like: unknown noise profile "nosy"; did you mean "noisy"?',
    ),
    "range the wrong way round": (
        after("    noise: {white_noise: [2e-4, 1e-4]}\n"),
        "hand.yaml:12:26: sensors.touch.noise.white_noise: [0.0002, 0.0001] is not ordered, expected [low, high]",
    ),
    "range of three": (
        after("    noise: {bias: [1, 2, 3]}\n"),
        "hand.yaml:12:19: sensors.touch.noise.bias: found a list of 3, expected a number or [low, high]",
    ),
    "share above one": (
        after("    noise: {dead_probability: [0, 1.5]}\n"),
        "hand.yaml:12:31: sensors.touch.noise.dead_probability: 1.5 is out of range, expected at most 1",
    ),
    "time constant of nothing": (
        after("    noise: {hysteresis: {strength: 0.5, time_constant: 0}}\n"),
        "hand.yaml:12:56: sensors.touch.noise.hysteresis.time_constant: 0 is out of range, expected more than 0",
    ),
    "unit of an amplitude's part": (
        after("    noise: {white_noise: {depth: 1 mm}}\n"),
        'hand.yaml:12:26: sensors.touch.noise.white_noise: depth: "1 mm" has a unit, expected a plain number: 0.001, if m is meant',
    ),
    "rate of nothing": (
        after("    rate: 0\n"),
        "hand.yaml:12:11: sensors.touch.rate: 0 is out of range, expected more than 0",
    ),
    "history of nothing": (
        after("    history: 0\n"),
        "hand.yaml:12:14: sensors.touch.history: found 0: input should be greater than or equal to 1",
    ),
    "unknown reduction": (
        after("    history: {length: 3, reduce: max}\n"),
        "hand.yaml:12:34: sensors.touch.history.reduce: found \"max\", expected 'stack', 'last', 'median' or 'mean'",
    ),
    "layout file that does not exist": (
        instead("layout.yaml", "lay.yaml"),
        'hand.yaml:2:32: robot.layout: there is no file "lay.yaml"; paths are relative to this document',
    ),
    "layout file with a name too long": (
        instead("layout.yaml", "a" * 300),
        f'hand.yaml:2:32: robot.layout: there is no file "{"a" * 300}"; paths are relative to this document',
    ),
    "layout in line": (
        instead("layout.yaml", "{resolutions: {low: {tip: {method: poisson, count: 3}}}}"),
        'hand.yaml:2:53: robot.layout.resolutions.low.tip: missing key "radius"',
    ),
    "tab": ("tgdsl: 1\n\trobot: 2\n", "hand.yaml:2:1: not YAML: found character '\\t' that cannot start any token"),
    "empty": ("", "hand.yaml:1:1: the document is empty"),
    "null": ("---\n~\n", "hand.yaml:1:1: the document is empty"),
    "text": ("hello\n", 'hand.yaml:1:1: found "hello", expected a mapping'),
    "list": ("- 1\n", "hand.yaml:1:1: found a list of 1, expected a mapping"),
    "huge version": (
        instead("tgdsl: 1", f"tgdsl: 0x{'f' * 5000}"),
        "hand.yaml:1:8: tgdsl: found a huge number: unable to parse input string as an integer, exceeded maximum size",
    ),
}

WRONG_LAYOUT = {
    "unknown key": (
        "radios: 2 mm",
        'layout.yaml:5:58: resolutions.low.index_tip.radios: unknown key "radios"; did you mean "radius"?',
    ),
    "region without an angle": (
        "region: {facing: [0, 0, 1]}",
        'layout.yaml:5:58: resolutions.low.index_tip.region: missing key "within"',
    ),
    "unknown key beside a region": (
        "region: [{box: {min: [0, 0, 0], max: [1, 1, 1]}, box2: 1}]",
        'layout.yaml:5:107: resolutions.low.index_tip.region[0].box2: unknown key "box2"; did you mean "box"?',
    ),
    "wrong value in a region": (
        "region: {box: {min: [0, 0, 0], max: [1, 1, x]}}",
        'layout.yaml:5:101: resolutions.low.index_tip.region.box.max[2]: "x" is not a quantity, '
        'expected a number in m or a string such as "4 µm"',
    ),
    "unordered box": (
        "region: {box: {min: [0, 0, 0], max: [1, 1, 0]}}",
        "layout.yaml:5:72: resolutions.low.index_tip.region.box: "
        "min [0.0, 0.0, 0.0] is not below max [1.0, 1.0, 0.0] on every axis",
    ),
    "no region": (
        "region: {ball: 3}",
        "layout.yaml:5:66: resolutions.low.index_tip.region: "
        "not a region, expected a mapping with one of the keys facing, box, sphere, geoms",
    ),
    "two of which one is wanted": (
        "spacing: 1 mm",
        "layout.yaml:5:16: resolutions.low.index_tip: expected exactly one of `count` and `spacing`",
    ),
}

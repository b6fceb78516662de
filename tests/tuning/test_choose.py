"""Choices of `accuracy`: checked on other states, for sensors that share an object, and with values that are written."""

import dataclasses
import warnings

import numpy as np
import pytest
from chosen_pads import chosen_document

import tgdsl
from tgdsl.compiler import pipeline
from tgdsl.compiler.pipeline import Choice
from tgdsl.errors import SpecError, TgdslError
from tgdsl.files import cache
from tgdsl.module.accuracy.errors import halves
from tgdsl.module.artifact import save_plan
from tgdsl.tuning import choose as choosing
from tgdsl.tuning.choose import choose
from tgdsl.tuning.compile import compile_plan
from tgdsl.tuning.recording import record

DEPTH = "depth: {kind: contact_depth, gate: geometric, accuracy: ACC}"
GRIDS = (1e-3, 2e-4, 5e-5, 1e-5)
"""Candidate tolerances of grids, coarse to fine [m]."""
KEYS = ("objects.stone.query", "objects.stone.tolerance")


@pytest.fixture(scope="module", autouse=True)
def _fresh_cache(tmp_path_factory):
    """Use short runs and a fresh cache that all tests of this file share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choosing, "ENVS", 6)
        patch.setattr(choosing, "STEPS", 30)
        patch.setenv("TGDSL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def depth_at(accuracy: str) -> str:
    return DEPTH.replace("ACC", accuracy)


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """Return states that no choice has seen, and their depths by raycast in float64."""
    document = chosen_document(tmp_path_factory.mktemp("others"), depth_at("1 %"))
    changes = {"sensors.depth.accuracy": None, "objects.stone.query": "raycast"}
    exact = tgdsl.compile(document, overrides=changes, dtype="float64")
    recording = record(exact, 6, steps=45, substeps=5, seed=11)
    return recording.states, read(exact, recording.states)


def read(touch, states):
    touch.free()
    return np.stack([touch(state)["depth"].double().numpy() for state in states])


def rms(depths, exact):
    """Return the RMS error over nonzero depths as a fraction of the largest; the median depth must be 0."""
    assert np.median(exact) == 0
    return float(np.sqrt(((depths - exact) ** 2).sum() / (exact != 0).sum()) / exact.max())


@pytest.mark.slow
def test_the_coarsest_accurate_variant_is_chosen(tmp_path, others):
    """It holds the accuracy on other states, and the next coarser grid does not; each accuracy gets another variant."""
    states, exact = others
    variants = set()
    for accuracy, bound in (("10 %", 0.1), ("1 %", 0.01), ("0.01 %", 1e-4)):
        document = chosen_document(tmp_path, depth_at(accuracy))
        assert rms(read(tgdsl.compile(document), states), exact) <= bound
        changes = choose(document).changes
        variants.add(str(changes))
        index = GRIDS.index(changes[KEYS[1]]) if changes[KEYS[0]] == "sdf" else len(GRIDS)
        if index:
            coarser = {"sensors.depth.accuracy": None, KEYS[1]: GRIDS[index - 1]}
            assert rms(read(tgdsl.compile(document, overrides=coarser), states), exact) > bound
    assert len(variants) == 3


@pytest.mark.slow
def test_an_absolute_accuracy_equals_its_relative_one(tmp_path, others):
    """10 µm are 0.3 % of a depth of about 3 mm."""
    states, exact = others
    document = chosen_document(tmp_path, depth_at("10 um"))
    assert rms(read(tgdsl.compile(document), states), exact) * exact.max() <= 1e-5
    relative = choose(chosen_document(tmp_path, depth_at(f"{100 * 1e-5 / exact.max():.2g} %"))).changes
    assert choose(document).changes == relative


@pytest.mark.slow
def test_the_stricter_sensor_decides_for_a_shared_object(tmp_path):
    document = chosen_document(tmp_path, depth_at("10 %"), depth_at("0.01 %").replace("depth:", "fine:"))
    plan = compile_plan(document)
    assert choose(document).changes == choose(chosen_document(tmp_path, depth_at("0.01 %"))).changes
    for sensor, is_moved in zip(plan.sensors, (True, False), strict=True):
        assert any("object stone: as fine as fine needs" in line for line in sensor.notes) is is_moved
    assert len(plan.quantities["contact_depth"].queries) == 1


@pytest.mark.slow
def test_sensors_without_an_accuracy_keep_their_tolerance(tmp_path):
    """The default tolerance is 0.05 mm."""
    plain = "plain: {kind: contact_depth, gate: geometric}"
    assert choose(chosen_document(tmp_path, depth_at("10 %"), plain)).changes[KEYS[1]] == 5e-5
    alone = choose(chosen_document(tmp_path, depth_at("10 %"), plain), sensors=["depth"])
    assert alone.changes[KEYS[1]] == 1e-3


@pytest.mark.slow
def test_written_values_stay(tmp_path):
    document = chosen_document(tmp_path, depth_at("10 %"), object=", tolerance: 0.02 mm")
    assert choose(document).changes == {}
    assert "left as written: objects.stone.tolerance" in tgdsl.compile(document).explain()
    document = chosen_document(tmp_path, depth_at("10 %"))
    assert choose(document, {KEYS[0]: "sdf"}).changes[KEYS[1]] == 1e-3


@pytest.mark.slow
def test_imperfections_do_not_change_the_choice(tmp_path):
    bare = choose(chosen_document(tmp_path, depth_at("1 %"))).changes
    imperfections = ", noise: noisy, rate: 50 Hz, history: 3, readout: both"
    document = chosen_document(tmp_path, depth_at("1 %").replace(", accuracy", f"{imperfections}, accuracy"))
    assert choose(document).changes == bare
    touch = tgdsl.compile(document)
    assert [output.name for output in touch.outputs] == ["depth", "depth/clean"]
    assert sum("accuracy 1 %" in line for sensor in touch.plan.sensors for line in sensor.notes) == 1


@pytest.mark.slow
def test_fields_and_distances_are_chosen_together(tmp_path):
    """Newton steps (4 by default) and the mesh query."""
    choice = choose(chosen_document(tmp_path, "force: {kind: force_taxel, gate: geometric, accuracy: 5 %}"))
    assert choice.changes[KEYS[0]] == "sdf" and choice.changes["sensors.force.moment_iterations"] < 4
    assert any("against 16 Newton steps, raycast in float64" in line for line in choice.notes["force"])


def forget_choices():
    """Remove choices from the cache; grids stay."""
    for entry in cache.entries():
        with np.load(entry.file) as arrays:
            is_choice = "choice" in arrays.files
        if is_choice:
            entry.file.unlink()


@pytest.mark.slow
def test_the_same_document_gives_the_same_bytes(tmp_path, monkeypatch):
    """With and without the choice in the cache."""
    document, plans = chosen_document(tmp_path, depth_at("1 %")), []
    for name in ("one", "two", "three"):
        if name == "two":
            forget_choices()
        elif name == "three":
            monkeypatch.setattr(choosing, "record", None)  # nothing may run again
        save_plan(compile_plan(document), tmp_path / f"{name}.safetensors")
        plans.append((tmp_path / f"{name}.safetensors").read_bytes())
    assert plans[0] == plans[1] == plans[2]
    assert "accuracy 1 %: grid" in tgdsl.load(tmp_path / "one.safetensors").explain()


@pytest.mark.slow
def test_the_origin_is_the_document_as_written(tmp_path):
    document = chosen_document(tmp_path, depth_at("10 %"))
    unchosen = pipeline.compile_document(document, choice=Choice(notes={"depth": ()})).plan
    assert compile_plan(document).origin == unchosen.origin


@pytest.mark.slow
def test_keys_of_choices_depend_on_document_and_scene(tmp_path):
    """Another mass changes only the motion; the key changes too."""
    document = chosen_document(tmp_path, depth_at("1 %"))
    keys = set()
    for text in (
        document.read_text(),
        document.read_text().replace("1 %", "2 %"),
        document.read_text().replace("radius: 4", "radius: 3"),
    ):
        document.write_text(text)
        task = choosing.task_of(document)
        keys.add(choosing.key_of(task))
    scene = document.parent / "scene.xml"
    scene.write_text(scene.read_text().replace('mass=".25"', 'mass=".3"'))
    keys.add(choosing.key_of(choosing.task_of(document)))
    assert len(keys) == 4


def test_both_halves_have_all_variants_of_objects():
    """Environment i starts with variant i modulo their number."""
    for num in (1, 2, 3, 5, 8):
        for half in halves(max(16, 2 * num)):
            assert set(np.arange(max(16, 2 * num))[half] % num) == set(range(num))


def test_documents_without_the_word_are_not_loaded(tmp_path):
    """Their mistakes are the compiler's to report."""
    for document in (tmp_path / "none.yaml", {}, {"sensors": {"depth": {"rates": [1]}}, "robot": 3}):
        assert choose(document) == choose(document, {"robot.model": "x.xml"}) == Choice()


def test_a_compiler_without_a_simulator_refuses_accuracy(tmp_path):
    with pytest.raises(TgdslError, match=r"pad\.yaml: depth: `accuracy` takes a run of the scene"):
        pipeline.compile_document(chosen_document(tmp_path, depth_at("1 %")))


def location_of(document, text):
    """Return `file:line:column` of a text in a document."""
    lines = document.read_text().splitlines()
    line = next(i for i, content in enumerate(lines) if text in content)
    return f"{document}:{line + 1}:{lines[line].index(text) + 1}"


@pytest.mark.parametrize(
    ("sensor", "at", "message"),
    [
        (
            "depth: {kind: contact_depth, gate: geometric, accuracy: 3 mN}",
            "3 mN",
            'sensors.depth.accuracy: "3 mN" is in N, and the reading has depth [m]; expected a fraction of the largest change, '
            'such as "1 %", or an amount in m',
        ),
        (
            "touch: {kind: kinematic_taxel, accuracy: 3 mN}",
            "3 mN",
            'sensors.touch.accuracy: "3 mN" is in N, and the reading has force [N], torque [N·m]; expected a fraction of the '
            'largest change, such as "1 %", or one of each: {force: … N, torque: 1 %}',
        ),
        (
            "touch: {kind: kinematic_taxel, accuracy: {force: 3 mN}}",
            "{force: 3 mN}",
            "sensors.touch.accuracy: the reading has torque too, without a bound; expected a bound of each quantity",
        ),
        (
            "touch: {kind: kinematic_taxel, outputs: [force], accuracy: {force: 1 %, torqe: 3 mN}}",
            "torqe",
            'sensors.touch.accuracy.torqe: the reading has no quantity "torqe"; did you mean "force"?',
        ),
        (
            "depth: {kind: contact_depth, accuracy: 5 furlongs}",
            "5 furlongs",
            'sensors.depth.accuracy: "5 furlongs" is no accuracy, expected a fraction such as "1 %", or an amount such as '
            '"0.02 mm"',
        ),
    ],
)
def test_wrong_accuracies_are_located_in_the_document(tmp_path, sensor, at, message):
    document = chosen_document(tmp_path, sensor)
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(document)
    (problem,) = caught.value.problems
    assert str(problem).startswith(f"{location_of(document, at)}: ") and message.split("; did")[0] in str(problem)


@pytest.mark.slow
def test_an_unreachable_accuracy_names_the_best_variant(tmp_path):
    document = chosen_document(tmp_path, depth_at("0.01 %"), object=", query: sdf")
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(document)
    (problem,) = caught.value.problems
    assert str(problem).startswith(
        f"{location_of(document, '0.01 %')}: sensors.depth.accuracy: nothing that is free to choose holds 0.01 %"
    )
    assert "best: grid, 0.01 mm, RMS error of depth 0.0" in problem.what
    assert problem.hint == "objects.stone.query stays as written; errors are against raycast"


def test_a_reading_that_never_changes_has_no_error(tmp_path):
    document = chosen_document(tmp_path, depth_at("1 %"))
    scene = document.parent / "scene.xml"
    text = scene.read_text().replace('timestep="0.002"', 'timestep="0.002" gravity="0 0 0"')
    scene.write_text(text.replace('pos="0 0 .0305"', 'pos="0 0 .5"').replace('ctrl="-5 .05"', 'ctrl="5 .05"'))
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(document)
    (problem,) = caught.value.problems
    assert problem.what.startswith("its depth never changes on these states (scripted run: ")


def test_a_scene_that_cannot_be_run_has_no_states(tmp_path):
    document = chosen_document(tmp_path, depth_at("1 %"))
    scene = document.parent / "scene.xml"
    scene.write_text(scene.read_text().replace('timestep="0.002"', 'timestep="0.002" integrator="RK4"'))
    with pytest.raises(SpecError, match=r"sensors\.depth\.accuracy: there are no states to measure errors on: .*RK4"):
        tgdsl.compile(document)


@pytest.mark.slow
def test_the_finest_variant_cannot_be_chosen(tmp_path, monkeypatch):
    """Without Warp, a grid of 0.01 mm is the reference of all others, so its own error is unknown."""

    def without_warp() -> None:
        raise TgdslError("distances to meshes need NVIDIA Warp")

    monkeypatch.setattr("tgdsl.geometry.bvh._warp", without_warp)
    forget_choices()
    document = chosen_document(tmp_path, depth_at("1 %"))
    assert choose(document).changes[KEYS[1]] == 2e-4
    forget_choices()
    with pytest.raises(SpecError, match=r"best: grid, 0\.05 mm, .*raycast is not available: .*NVIDIA Warp"):
        choose(chosen_document(tmp_path, depth_at("0.01 %")))
    with pytest.raises(SpecError, match=r"grid, 0\.01 mm is the finest variant.*NVIDIA Warp"):
        choose(chosen_document(tmp_path, depth_at("0.01 %"), object=", tolerance: 0.01 mm"))


@pytest.mark.slow
def test_warnings_of_the_document_appear_once(tmp_path):
    document = chosen_document(tmp_path, depth_at("10 %").replace(", accuracy", ", rate: 0.05, accuracy"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tgdsl.compile(document)
    assert [str(warning.message).count("usually at least 0.1 Hz") for warning in caught] == [1]


def test_packed_choices_unpack_unchanged(tmp_path):
    choice = Choice({"objects.a.tolerance": 1e-3, "sensors.b.operator": None}, {"b": ("one", "  zwei, ≤")})
    unpacked = choosing.unpacked(choosing.packed(choice))
    assert dataclasses.asdict(unpacked) == dataclasses.asdict(choice)


SOUND = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <body name="plate"><geom type="box" size=".1 .1 .005"/></body>
    <body name="ball" pos="0 0 .018"><freejoint/><geom type="sphere" size=".01" mass=".05"/></body>
  </worldbody>
</mujoco>
"""
RUNG = [{"frequency": 523.0, "decay": 6.0, "gain": 2.0}, {"frequency": 2903.0, "decay": 55.0, "gain": 1.0}]


def sounding_document(tmp_path, **sensor):
    (tmp_path / "sound.xml").write_text(SOUND)
    merged = {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": RUNG, "scrape": 0, "samples": 16, **sensor}
    return {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "sound.xml")},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"s": merged},
    }


def test_modes_are_chosen_by_their_share_of_the_sound(tmp_path):
    """The quiet mode starts at half of the loud one's amplitude and decays within the run: 1 % needs both, 50 % one.

    A single mode that is written stays, and its error against both is too large.
    """
    for accuracy, modes in (("1 %", 2), ("50 %", 1)):
        touch = tgdsl.compile(sounding_document(tmp_path, accuracy=accuracy))
        assert touch.plan.sensors[0].constants["frequency"].shape == (1, modes)
    with pytest.raises(SpecError, match=r"sensors\.s\.accuracy: nothing that is free to choose holds 1 %"):
        tgdsl.compile(sounding_document(tmp_path, accuracy="1 %", loudest=1))


def test_states_are_recorded_at_the_steps_of_the_sensor(tmp_path):
    """One physics step per call: 16 samples of 1 ms; the run lasts as long as with five, and no mode is dropped."""
    touch = tgdsl.compile(sounding_document(tmp_path))
    recording = record(touch, 2, steps=10)
    assert {state.dt for state in recording.states} == {0.001} and len(recording.states) == 50

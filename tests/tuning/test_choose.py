"""What `accuracy` chooses: on states that took no part, by sensors that share an object, and what is left as written."""

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
"""Tolerances of grids that are chosen among, coarse to fine [m]."""
KEYS = ("objects.stone.query", "objects.stone.tolerance")


@pytest.fixture(scope="module", autouse=True)
def _kept_by_themselves(tmp_path_factory):
    """Grids are baked once for all of these tests, and choices are not those of earlier runs; runs are short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choosing, "ENVS", 6)
        patch.setattr(choosing, "STEPS", 30)
        patch.setenv("TGDSL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def depth_at(accuracy: str) -> str:
    return DEPTH.replace("ACC", accuracy)


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """States of other environments than those of any choice, and what raycast in float64 reads of them."""
    made = chosen_document(tmp_path_factory.mktemp("others"), depth_at("1 %"))
    changes = {"sensors.depth.accuracy": None, "objects.stone.query": "raycast"}
    exact = tgdsl.compile(made, overrides=changes, dtype="float64")
    recording = record(exact, 6, steps=45, substeps=5, seed=11)
    return recording.states, read(exact, recording.states)


def read(touch, states):
    touch.free()
    return np.stack([touch(state)["depth"].double().numpy() for state in states])


def rms(found, exact):
    """Root mean square over what is felt, as a fraction of the largest depth: of depths the median is 0."""
    assert np.median(exact) == 0
    return float(np.sqrt(((found - exact) ** 2).sum() / (exact != 0).sum()) / exact.max())


@pytest.mark.slow
def test_the_coarsest_variant_is_chosen_that_holds_the_accuracy_on_other_states(tmp_path, others):
    """The next coarser grid, which takes fewer operations or bytes, does not hold it there; each accuracy has another variant."""
    states, exact = others
    variants = set()
    for accuracy, bound in (("10 %", 0.1), ("1 %", 0.01), ("0.01 %", 1e-4)):
        document = chosen_document(tmp_path, depth_at(accuracy))
        assert rms(read(tgdsl.compile(document), states), exact) <= bound
        changes = choose(document).changes
        variants.add(str(changes))
        place = GRIDS.index(changes[KEYS[1]]) if changes[KEYS[0]] == "sdf" else len(GRIDS)
        if place:
            coarser = {"sensors.depth.accuracy": None, KEYS[1]: GRIDS[place - 1]}
            assert rms(read(tgdsl.compile(document, overrides=coarser), states), exact) > bound
    assert len(variants) == 3


@pytest.mark.slow
def test_an_amount_is_held_in_its_unit(tmp_path, others):
    """0.3 % of a depth of some 3 mm are 10 µm."""
    states, exact = others
    made = chosen_document(tmp_path, depth_at("10 um"))
    assert rms(read(tgdsl.compile(made), states), exact) * exact.max() <= 1e-5
    relative = choose(chosen_document(tmp_path, depth_at(f"{100 * 1e-5 / exact.max():.2g} %"))).changes
    assert choose(made).changes == relative


@pytest.mark.slow
def test_the_stricter_of_two_sensors_decides_on_their_object(tmp_path):
    made = chosen_document(tmp_path, depth_at("10 %"), depth_at("0.01 %").replace("depth:", "fine:"))
    plan = compile_plan(made)
    assert choose(made).changes == choose(chosen_document(tmp_path, depth_at("0.01 %"))).changes
    assert any("object stone: as fine as fine needs" in line for line in plan.sensors[0].notes)
    assert len(plan.quantities["contact_depth"].queries) == 1


@pytest.mark.slow
def test_sensors_without_an_accuracy_keep_what_they_have(tmp_path):
    """What nobody wrote is 0.05 mm."""
    plain = "plain: {kind: contact_depth, gate: geometric}"
    assert choose(chosen_document(tmp_path, depth_at("10 %"), plain)).changes[KEYS[1]] == 5e-5
    alone = choose(chosen_document(tmp_path, depth_at("10 %"), plain), sensors=["depth"])
    assert alone.changes[KEYS[1]] == 1e-3


@pytest.mark.slow
def test_what_is_written_stays(tmp_path):
    made = chosen_document(tmp_path, depth_at("10 %"), object=", tolerance: 0.02 mm")
    assert choose(made).changes == {}
    assert "left as written: objects.stone.tolerance" in tgdsl.compile(made).explain()
    made = chosen_document(tmp_path, depth_at("10 %"))
    assert choose(made, {KEYS[0]: "sdf"}).changes[KEYS[1]] == 1e-3


@pytest.mark.slow
def test_imperfections_change_nothing_of_it(tmp_path):
    bare = choose(chosen_document(tmp_path, depth_at("1 %"))).changes
    more = ", noise: noisy, rate: 50 Hz, history: 3, readout: both"
    made = chosen_document(tmp_path, depth_at("1 %").replace(", accuracy", f"{more}, accuracy"))
    assert choose(made).changes == bare
    touch = tgdsl.compile(made)
    assert [output.name for output in touch.outputs] == ["depth", "depth/clean"]
    assert sum("accuracy 1 %" in line for sensor in touch.plan.sensors for line in sensor.notes) == 1


@pytest.mark.slow
def test_fields_and_distances_are_chosen_together(tmp_path):
    """Newton steps, 4 if nobody writes them, and how the mesh is asked."""
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
    """With the choice in the cache, and without."""
    made, found = chosen_document(tmp_path, depth_at("1 %")), []
    for name in ("one", "two", "three"):
        if name == "two":
            forget_choices()
        elif name == "three":
            monkeypatch.setattr(choosing, "record", None)  # nothing is run again
        save_plan(compile_plan(made), tmp_path / f"{name}.safetensors")
        found.append((tmp_path / f"{name}.safetensors").read_bytes())
    assert found[0] == found[1] == found[2]
    assert "accuracy 1 %: grid" in tgdsl.load(tmp_path / "one.safetensors").explain()


@pytest.mark.slow
def test_the_origin_is_the_document_as_written(tmp_path):
    made = chosen_document(tmp_path, depth_at("10 %"))
    unchosen = pipeline.compile_document(made, choice=Choice(notes={"depth": ()})).plan
    assert compile_plan(made).origin == unchosen.origin


@pytest.mark.slow
def test_a_choice_follows_from_what_the_document_says(tmp_path):
    """Another mass changes the motion, not what is computed of it; still it is looked at again."""
    made = chosen_document(tmp_path, depth_at("1 %"))
    keys = set()
    for text in (made.read_text(), made.read_text().replace("1 %", "2 %"), made.read_text().replace("radius: 4", "radius: 3")):
        made.write_text(text)
        task = choosing.task_of(made)
        keys.add(choosing.key_of(task))
    scene = made.parent / "scene.xml"
    scene.write_text(scene.read_text().replace('mass=".25"', 'mass=".3"'))
    keys.add(choosing.key_of(choosing.task_of(made)))
    assert len(keys) == 4


def test_all_variants_of_objects_choose_and_verify():
    """Environment i begins with variant i modulo their number."""
    for num in (1, 2, 3, 5, 8):
        for half in halves(max(16, 2 * num)):
            assert set(np.arange(max(16, 2 * num))[half] % num) == set(range(num))


def test_a_compiler_without_a_simulator_refuses_it(tmp_path):
    with pytest.raises(TgdslError, match=r"pad\.yaml: depth: `accuracy` takes a run of the scene"):
        pipeline.compile_document(chosen_document(tmp_path, depth_at("1 %")))


def place_of(document, text):
    """Return line and column of a text in a document."""
    lines = document.read_text().splitlines()
    line = next(i for i, own in enumerate(lines) if text in own)
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
def test_what_is_wrong_is_told_where_it_stands(tmp_path, sensor, at, message):
    made = chosen_document(tmp_path, sensor)
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(made)
    (problem,) = caught.value.problems
    assert str(problem).startswith(f"{place_of(made, at)}: ") and message.split("; did")[0] in str(problem)


@pytest.mark.slow
def test_what_nothing_holds_names_the_best(tmp_path):
    made = chosen_document(tmp_path, depth_at("0.01 %"), object=", query: sdf")
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(made)
    (problem,) = caught.value.problems
    assert str(problem).startswith(
        f"{place_of(made, '0.01 %')}: sensors.depth.accuracy: nothing that is free to choose holds 0.01 %"
    )
    assert "best: grid, 0.01 mm, RMS error of depth 0.0" in problem.what
    assert problem.hint == "objects.stone.query stays as written; errors are against raycast"


def test_a_reading_that_never_changes_has_no_error(tmp_path):
    made = chosen_document(tmp_path, depth_at("1 %"))
    scene = made.parent / "scene.xml"
    text = scene.read_text().replace('timestep="0.002"', 'timestep="0.002" gravity="0 0 0"')
    scene.write_text(text.replace('pos="0 0 .0305"', 'pos="0 0 .5"').replace('ctrl="-5 .05"', 'ctrl="5 .05"'))
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(made)
    (problem,) = caught.value.problems
    assert problem.what.startswith("its depth never changes on these states (scripted run: ")


def test_a_scene_that_cannot_be_run_has_no_states(tmp_path):
    made = chosen_document(tmp_path, depth_at("1 %"))
    scene = made.parent / "scene.xml"
    scene.write_text(scene.read_text().replace('timestep="0.002"', 'timestep="0.002" integrator="RK4"'))
    with pytest.raises(SpecError, match=r"sensors\.depth\.accuracy: there are no states to measure errors on: .*RK4"):
        tgdsl.compile(made)


@pytest.mark.slow
def test_without_anything_finer_nothing_is_known_of_an_error(tmp_path, monkeypatch):
    """Without Warp a grid of 0.01 mm is the finest: others are measured against it, itself it cannot be chosen."""

    def none() -> None:
        raise TgdslError("distances to meshes need NVIDIA Warp")

    monkeypatch.setattr("tgdsl.geometry.bvh._warp", none)
    forget_choices()
    made = chosen_document(tmp_path, depth_at("1 %"))
    assert choose(made).changes[KEYS[1]] == 2e-4
    forget_choices()
    with pytest.raises(SpecError, match=r"best: grid, 0\.05 mm, .*raycast is not available: .*NVIDIA Warp"):
        choose(chosen_document(tmp_path, depth_at("0.01 %")))
    with pytest.raises(SpecError, match=r"grid, 0\.01 mm is the finest variant.*NVIDIA Warp"):
        choose(chosen_document(tmp_path, depth_at("0.01 %"), object=", tolerance: 0.01 mm"))


@pytest.mark.slow
def test_the_document_is_warned_of_once(tmp_path):
    made = chosen_document(tmp_path, depth_at("10 %").replace(", accuracy", ", rate: 0.05, accuracy"))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        tgdsl.compile(made)
    assert [str(own.message).count("usually at least 0.1 Hz") for own in found] == [1]


def test_a_choice_is_kept_as_it_is(tmp_path):
    choice = Choice({"objects.a.tolerance": 1e-3, "sensors.b.operator": None}, {"b": ("one", "  zwei, ≤")})
    again = choosing.unpacked(choosing.packed(choice))
    assert dataclasses.asdict(again) == dataclasses.asdict(choice)


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


def sounding(tmp_path, **sensor):
    (tmp_path / "sound.xml").write_text(SOUND)
    given = {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": RUNG, "scrape": 0, "samples": 16, **sensor}
    return {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "sound.xml")},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"s": given},
    }


def test_modes_of_a_sound_are_chosen_by_their_part_of_it(tmp_path):
    """The quiet mode begins with half of the loud one's amplitude and decays within the run: 1 % needs both, 50 % not.

    Written, one mode stays, and its error is against both: too large.
    """
    for accuracy, modes in (("1 %", 2), ("50 %", 1)):
        touch = tgdsl.compile(sounding(tmp_path, accuracy=accuracy))
        assert touch.plan.sensors[0].constants["frequency"].shape == (1, modes)
    with pytest.raises(SpecError, match=r"sensors\.s\.accuracy: nothing that is free to choose holds 1 %"):
        tgdsl.compile(sounding(tmp_path, accuracy="1 %", loudest=1))


def test_states_are_recorded_at_the_steps_that_a_sensor_wants(tmp_path):
    """One physics step per call: 16 samples of 1 ms, of which no mode is dropped; the run lasts as long as with five."""
    touch = tgdsl.compile(sounding(tmp_path))
    recording = record(touch, 2, steps=10)
    assert {state.dt for state in recording.states} == {0.001} and len(recording.states) == 50

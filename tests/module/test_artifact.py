"""Artefacts: reproducible, written atomically, and refused with a reason if they are something else."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.errors import ArtifactError, TgdslError
from tgdsl.module.artifact import load_plan, save_plan
from tgdsl.plan import tree
from tgdsl.plan.plan import FORMAT

SCENE = """
<mujoco>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="ball" pos="1 0 .03"><freejoint/><geom size=".02"/></body>
  </worldbody>
</mujoco>
"""
DOCUMENT = """
tgdsl: 1
robot:
  model: scene.xml
  layout:
    groups: {b: [pad], a: ["p*"]}
    resolutions:
      even: {pad: {method: poisson, count: 20, radius: 4 mm}}
objects: {cube: {body: cube}, ball: {body: ball}}
sensors:
  touch: {kind: kinematic_taxel, links: b, feels: [cube, ball], outputs: [force]}
  bit: {kind: contact, links: [pad], feels: [ball], threshold: 1 mm, release_threshold: 0.5 mm}
observations:
  policy: [{type: force, of: touch}, {type: agg_bool, of: bit}]
"""
REACH = "quantities/contact_depth/uses/0/reach"
"""An array of the plan: the range of each probe for each object."""


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    folder = tmp_path_factory.mktemp("document")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "hand.yaml").write_text(DOCUMENT)
    return folder / "hand.yaml"


@pytest.fixture(scope="module")
def artifact(document):
    save_plan(compile_document(document).plan, document.parent / "hand.safetensors")
    return document.parent / "hand.safetensors"


def test_an_artefact_has_hashes_of_robot_and_document(tmp_path):
    """SHA-256 of the robot's file with its includes, and of the document's content without comments."""
    (tmp_path / "scene.xml").write_text(SCENE.replace("<worldbody>", '<include file="more.xml"/><worldbody>', 1))
    (tmp_path / "more.xml").write_text("<mujocoinclude><option timestep='0.002'/></mujocoinclude>")
    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    origin = compile_document(tmp_path / "hand.yaml").plan.origin
    content = (tmp_path / "scene.xml").read_bytes() + (tmp_path / "more.xml").read_bytes()
    assert origin.robot_sha256 == hashlib.sha256(content).hexdigest()
    (tmp_path / "hand.yaml").write_text("# a remark\n" + DOCUMENT)
    assert compile_document(tmp_path / "hand.yaml").plan.origin.document_sha256 == origin.document_sha256
    (tmp_path / "hand.yaml").write_text(DOCUMENT.replace("1 mm", "1.1 mm"))
    assert compile_document(tmp_path / "hand.yaml").plan.origin.document_sha256 != origin.document_sha256


def test_artefacts_are_reproducible(document, artifact, tmp_path):
    size = save_plan(compile_document(document).plan, tmp_path / "again.safetensors")
    content = artifact.read_bytes()
    assert (tmp_path / "again.safetensors").read_bytes() == content
    assert size == len(content)


@pytest.mark.slow
def test_artefacts_are_reproducible_in_other_processes(document, artifact, tmp_path):
    program = "import sys; from tgdsl.module.artifact import *; from tgdsl.compiler.pipeline import *; save_plan(compile_document(sys.argv[1]).plan, sys.argv[2])"
    for seed in ("1", "4242"):
        out = tmp_path / f"{seed}.safetensors"
        command = [sys.executable, "-c", program, str(document), str(out)]
        subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": seed}, cwd=tmp_path, check=True)
        assert out.read_bytes() == artifact.read_bytes()


def test_a_plan_round_trips(document, artifact):
    plan, loaded = compile_document(document).plan, load_plan(artifact)
    for field in dataclasses.fields(plan):
        (expected, _), (result, _) = (tree.flatten(getattr(side, field.name), field.name) for side in (plan, loaded))
        assert result == expected and type(getattr(loaded, field.name)) is type(getattr(plan, field.name)), field.name
    assert loaded.inputs == plan.inputs and loaded.origin == plan.origin and loaded.objects == plan.objects
    assert [type(part) for part in loaded.quantities.values()] == [type(part) for part in plan.quantities.values()]
    assert list(loaded.arrays) == list(plan.arrays)
    for name, array in plan.arrays.items():
        assert loaded.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded.arrays[name], array)
        with pytest.raises(ValueError, match="read-only"):
            loaded.arrays[name][...] = 0


def test_a_loaded_module_reads_the_same(document, artifact, tmp_path):
    touch = tgdsl.compile(document)
    assert tgdsl.save(touch, tmp_path / "saved.safetensors") == artifact.stat().st_size
    loaded = tgdsl.load(tmp_path / "saved.safetensors")
    state = touch.example_state(16)
    for name, reading in touch(state).items():
        assert torch.equal(loaded(state)[name], reading)
    assert loaded.inputs == touch.inputs
    assert tgdsl.load(artifact, dtype=torch.float64).dtype == torch.float64


def refusal_of(path) -> str:
    with pytest.raises(ArtifactError) as caught:
        tgdsl.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize("keep", [0, 4, 100, -1], ids=["empty", "no_header", "half_header", "last_byte_gone"])
def test_truncated_files_are_refused(artifact, tmp_path, keep):
    (tmp_path / "t.safetensors").write_bytes(artifact.read_bytes()[:keep])
    assert refusal_of(tmp_path / "t.safetensors").startswith("cannot read this artefact: ")


def test_a_damaged_header_is_refused(artifact, tmp_path):
    content = bytearray(artifact.read_bytes())
    content[20:40] = b"\xff" * 20
    (tmp_path / "d.safetensors").write_bytes(content)
    assert refusal_of(tmp_path / "d.safetensors").startswith("cannot read this artefact: ")


def test_files_that_are_not_artefacts_are_refused(tmp_path):
    assert refusal_of(tmp_path / "none.safetensors").startswith("cannot read this artefact: ")
    (tmp_path / "folder.safetensors").mkdir()
    assert refusal_of(tmp_path / "folder.safetensors").startswith("this is a folder, expected an artefact")
    (tmp_path / "hand.yaml").write_text("tgdsl: 1\n")
    assert refusal_of(tmp_path / "hand.yaml") == "this is a document, not an artefact; tgdsl.compile reads documents"
    (tmp_path / "foreign.safetensors").write_bytes(save({"weight": np.zeros(3)}, {"format": "pt"}))
    assert refusal_of(tmp_path / "foreign.safetensors") == "this safetensors file was not written by tgdsl"
    (tmp_path / "bare.safetensors").write_bytes(save({"weight": np.zeros(3)}))
    assert refusal_of(tmp_path / "bare.safetensors") == "this safetensors file was not written by tgdsl"


def write_with_plan(artifact, path, text: str) -> None:
    path.write_bytes(save(load(artifact.read_bytes()), {"tgdsl": text}))


def test_other_versions_and_contents_are_refused(artifact, tmp_path):
    path, plain = tmp_path / "other.safetensors", json.loads(load_plan(artifact).to_json())
    write_with_plan(artifact, path, json.dumps(plain | {"format": FORMAT + 1}))
    assert (
        refusal_of(path)
        == f"plan format {FORMAT + 1} is not {FORMAT}, which this version of tgdsl reads; compile the document again"
    )
    write_with_plan(artifact, path, json.dumps({k: v for k, v in plain.items() if k != "format"}))
    assert (
        refusal_of(path) == f"plan format None is not {FORMAT}, which this version of tgdsl reads; compile the document again"
    )
    write_with_plan(artifact, path, json.dumps({k: v for k, v in plain.items() if k != "layout"}))
    assert refusal_of(path).startswith("not a plan: ")
    write_with_plan(artifact, path, json.dumps(plain | {"layout": 3}))
    assert refusal_of(path).startswith("not a plan: ")
    for text in ("", "{", "3", "null"):
        write_with_plan(artifact, path, text)
        assert refusal_of(path).startswith("not a plan: ")


def test_an_unknown_kind_is_named(artifact, tmp_path):
    path, plain = tmp_path / "own.safetensors", json.loads(load_plan(artifact).to_json())
    plain["sensors"][0]["kind"] = "kinematic_taxle"
    write_with_plan(artifact, path, json.dumps(plain))
    with pytest.raises(TgdslError) as caught:
        tgdsl.load(path)
    assert str(caught.value) == (
        'sensor "touch" is of kind "kinematic_taxle", which is neither installed nor given as `kinds`; did you mean "kinematic_taxel"?'
    )


def test_a_failed_save_keeps_the_old_file(artifact, tmp_path, monkeypatch):
    plan, path = load_plan(artifact), tmp_path / "hand.safetensors"
    path.write_bytes(b"before")

    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space left"):
        save_plan(plan, path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_artefact_has_the_mode_of_a_new_file(artifact, tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    save_plan(load_plan(artifact), tmp_path / "hand.safetensors")
    assert (tmp_path / "hand.safetensors").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.safetensors", "plain"]


def test_changed_arrays_are_refused(artifact, tmp_path):
    content = artifact.read_bytes()
    arrays = load(content)
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
    changed = {**arrays, REACH: arrays[REACH] * 2}
    without_reach = {name: value for name, value in arrays.items() if name != REACH}
    with_other_dtype = {**arrays, REACH: arrays[REACH].astype(np.float16)}
    for bad in (
        changed,
        without_reach,
        {**without_reach, "quantities/reach": arrays[REACH]},
        {**arrays, "quantities/reach": arrays[REACH]},
        with_other_dtype,
    ):
        (tmp_path / "bad.safetensors").write_bytes(save(bad, header))
        assert refusal_of(tmp_path / "bad.safetensors") == "the arrays differ from the arrays that the plan was written with"

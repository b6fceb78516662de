"""Exported steps: the file computes the same as the module, for any number of environments, without tgdsl."""

import contextlib
import dataclasses
import io
import json
import shutil
import subprocess
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from every_kind import SENSORS as EVERY_KIND
from every_kind import every_kind
from noisy_modules import CONTACT_NOISE, EVERY_KNOB, document, felt_state
from oracles.geometry import mesh_scene

import tgdsl
from tgdsl.commands.documents import Export, Verify
from tgdsl.errors import ArtifactError, TgdslError
from tgdsl.module.export.program import read_signature
from tgdsl.module.export.verify import Verdict, verify

ROOT = Path(__file__).parents[3]
SENSORS = {
    "a": {"noise": EVERY_KNOB, "history": 3, "rate": 40},
    "c": {"kind": "contact", "noise": CONTACT_NOISE, "history": {"length": 4, "reduce": "median"}},
}
OBSERVED = {
    "observations": {
        "policy": [{"type": "force_torque", "of": "a"}, {"type": "agg_bool", "of": "c"}, {"type": "cop", "of": "a"}]
    }
}
needs_onnx = pytest.mark.skipif(
    not find_spec("onnxruntime"), reason='onnxruntime is not installed: pip install "tgdsl[export]"'
)
needs_compiler = pytest.mark.skipif(not (shutil.which("g++") and shutil.which("cmake")), reason="g++ or cmake is not installed")
ONNX_NOISE = "ignore:.*(treespec|LeafSpec).*:FutureWarning"


@pytest.fixture
def noisy(tmp_path):
    return tgdsl.compile(document(tmp_path, SENSORS, **OBSERVED)).seed(11)


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """Return a small module with random numbers, rings and clocks, its exported file, and the command's output."""
    folder = tmp_path_factory.mktemp("brief")
    noise = {"read_delay": 0.013, "gain": [0.8, 1.2]}
    (folder / "hand.yaml").write_text(json.dumps(document(folder, {"a": {"noise": noise}}), default=float))
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        Export(folder / "hand.yaml", dt=0.01).run()
    return tgdsl.compile(folder / "hand.yaml"), folder / "hand.pt2", printed.getvalue()


def of_kinds(folder: Path, *names: str) -> tgdsl.TactileModule:
    """Return a module with some sensors of `every_kind`, without noise."""
    sensors = {name: {key: value for key, value in EVERY_KIND[name].items() if key != "noise"} for name in names}
    return every_kind(folder, sensors)


@pytest.mark.slow
def test_a_file_with_all_noise_computes_the_same_as_the_module(noisy, tmp_path):
    """All kinds of noise, delays, rates, histories, observations and resets; batches of 1, 7 and 64; without importing tgdsl."""
    noisy(felt_state(noisy))
    signature = noisy.export(tmp_path / "hand.pt2", dt=0.01)
    assert noisy.num_envs == 4, "the module stays as it is"
    assert read_signature(tmp_path / "hand.pt2") == signature
    verdict = verify(tmp_path / "hand.pt2", noisy, num_calls=12)
    assert list(verdict.differences) == [1, 7, 64]
    assert verdict.differences[7].keys() == {"reading/a", "reading/c", "observation/policy"}
    assert verdict.worst <= 1e-6 and verdict.is_equal
    with pytest.raises(ArtifactError, match="does not say what it was exported from; name it with --of"):
        Verify(tmp_path / "hand.pt2").run()


def test_a_file_computes_the_same_as_the_module(brief):
    touch, file, _ = brief
    verdict = verify(file, touch, num_calls=3)
    assert list(verdict.differences) == [1, 7, 64] and verdict.worst <= 1e-6 and verdict.is_equal


@pytest.mark.slow
def test_other_random_numbers_are_detected(brief):
    touch, file, _ = brief
    other = verify(file, tgdsl.TactileModule(touch.plan).seed(12), num_calls=3)
    assert other.worst > 0.01 and not other.is_equal


def test_inputs_that_do_not_fit_are_refused(brief):
    _, file, _ = brief
    signature = read_signature(file)
    program = torch.export.load(file).module()
    inputs = [torch.zeros(5, *port.shape, dtype=getattr(torch, port.dtype)) for port in signature.inputs]
    assert len(program(*inputs)) == len(signature.outputs)
    for i, tensor in enumerate(inputs):
        for wrong in (tensor.to(torch.float64), tensor[:3]):
            with pytest.raises((RuntimeError, AssertionError)):
                program(*inputs[:i], wrong, *inputs[i + 1 :])


@pytest.mark.slow
def test_states_may_be_in_double_precision(tmp_path):
    touch = tgdsl.compile(document(tmp_path, {"a": {}}))
    signature = touch.export(tmp_path / "hand.pt2", dt=0.01, state_dtype="float64")
    assert {port.name: port.dtype for port in signature.inputs}["body_pos"] == "float64"
    assert verify(tmp_path / "hand.pt2", touch, num_calls=3).is_equal


def test_unsupported_exports_are_refused(brief, tmp_path):
    import trimesh

    noisy, _, _ = brief
    touch, _ = mesh_scene(trimesh.creation.box((0.04, 0.04, 0.04)), [(0, 0, 0.025)], query="raycast", surface="visual")
    with pytest.raises(TgdslError, match="s cannot be exported: `query: raycast` searches triangles with NVIDIA Warp"):
        touch.export(tmp_path / "hand.pt2")
    with pytest.raises(TgdslError, match="expected `dt`, the time between steps"):
        noisy.export(tmp_path / "hand.pt2")
    with pytest.raises(TgdslError, match=r"found 'hand\.txt', expected one of pt2, aoti, onnx"):
        noisy.export(tmp_path / "hand.txt", dt=0.01)
    with pytest.raises(TgdslError, match=r"the format onnx has the ending \.onnx"):
        noisy.export(tmp_path / "hand.pt2", "onnx", dt=0.01)
    assert not (tmp_path / "hand.pt2").exists()


def test_foreign_and_damaged_files_and_other_taxels_are_refused(brief, tmp_path):
    _, file, _ = brief
    (tmp_path / "text.pt2").write_text("no archive")
    with zipfile.ZipFile(tmp_path / "empty.pt2", "w"):
        pass
    for name in ("text.pt2", "empty.pt2"):
        with pytest.raises(ArtifactError, match="expected a whole file that `tgdsl export` wrote"):
            read_signature(tmp_path / name)
    with pytest.raises(ArtifactError, match="cannot be read: No such file"):
        read_signature(tmp_path / "none.pt2")
    whole = file.read_bytes()
    (tmp_path / "text.pt2").write_bytes(whole[:-100])
    with pytest.raises(ArtifactError, match="expected a whole file that `tgdsl export` wrote"):
        read_signature(tmp_path / "text.pt2")
    middle = len(whole) // 2
    (tmp_path / "text.pt2").write_bytes(whole[:middle] + bytes(b ^ 1 for b in whole[middle : middle + 9]) + whole[middle + 9 :])
    with pytest.raises(ArtifactError, match=r"expected a whole file .* is damaged"):
        read_signature(tmp_path / "text.pt2")
    with pytest.raises(ArtifactError, match="its taxels are other ones than the module's"):
        verify(file, tgdsl.compile(document(tmp_path, {"a": {"links": "tip"}})))


def test_the_commands_export_and_verify(brief, capsys, monkeypatch):
    """`verify` compares the file with the document that it was exported from."""
    touch, file, printed = brief
    assert "in    0  body_pos                          float32  (env, 3, 3)" in printed
    assert "tgdsl verify hand.pt2" in printed

    def verified(path, module, num_calls, progress):
        assert (path, module.plan.origin, num_calls) == (file, touch.plan.origin, 2)
        return Verdict({64: {"reading/a": 0.0}}, True)

    monkeypatch.setattr("tgdsl.module.export.verify.verify", verified)
    Verify(file, calls=2).run()
    verdict = capsys.readouterr().out
    assert "64 environments, 2 calls" in verdict and "inputs of a wrong dtype are refused" in verdict


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* is compiled for 1 steps of 0.002 s")
def test_every_kind_is_exported(tmp_path):
    touch = of_kinds(tmp_path, *EVERY_KIND)
    touch.export(tmp_path / "hand.pt2", dt=0.01)
    verdict = verify(tmp_path / "hand.pt2", touch, num_calls=10)
    assert verdict.differences[7].keys() >= {f"reading/{name}" for name in EVERY_KIND}
    assert verdict.worst <= 1e-6


@pytest.mark.slow
@needs_onnx
@pytest.mark.filterwarnings(ONNX_NOISE)
@pytest.mark.parametrize("name", ["noisy", "force", "heat", "skin"])
def test_onnx_runtime_computes_the_same_as_the_module(name, request, tmp_path):
    touch = request.getfixturevalue("noisy") if name == "noisy" else of_kinds(tmp_path, name)
    touch.export(tmp_path / "hand.onnx", dt=0.01)
    assert verify(tmp_path / "hand.onnx", touch, num_calls=10).is_equal


@pytest.mark.slow
@needs_compiler
@pytest.mark.filterwarnings(ONNX_NOISE)
def test_a_compiled_package_computes_the_same_in_python_and_cpp(tmp_path):
    """Generating a package is slow, so one test serves both; it builds examples/cpp."""
    noise = {"gain": [0.8, 1.2], "read_delay": 0.013, "white_noise": 2e-4}
    touch = tgdsl.compile(document(tmp_path, {"a": {"kind": "contact_depth", "noise": noise, "history": 3}})).seed(11)
    signature = touch.export(tmp_path / "hand.aoti.pt2", dt=0.01)
    assert verify(tmp_path / "hand.aoti.pt2", touch, num_calls=10).is_equal
    program = torch._inductor.aoti_load_package(str(tmp_path / "hand.aoti.pt2"))
    inputs = [torch.zeros(5, *port.shape, dtype=getattr(torch, port.dtype)) for port in signature.inputs]
    assert len(program(*inputs)) == len(signature.outputs)
    for i, tensor in enumerate(inputs):
        for wrong in (tensor.to(torch.float64), tensor[:3]):
            with pytest.raises(RuntimeError):
                program(*inputs[:i], wrong, *inputs[i + 1 :])
    build = ["cmake", "-S", str(ROOT / "examples" / "cpp"), "-B", str(tmp_path / "build")]
    subprocess.run([*build, f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", str(tmp_path / "build")], check=True, capture_output=True)
    memory, num_envs = touch.initial_memory(7, 0.01), 7
    lines = []
    for call in range(5):
        state = dataclasses.replace(felt_state(touch, num_envs, call).to(torch.float32), dt=0.01)
        state.contact_found = state.contact_found > 0
        reset = torch.arange(num_envs) == call
        inputs = {**touch.incoming.tensors(state, touch.dtype, touch.device), "reset": reset}
        for port in signature.inputs:
            if not port.name.startswith("memory/"):
                file = tmp_path / f"{call}_{port.name.replace('/', '_')}.bin"
                file.write_bytes(inputs[port.name].contiguous().numpy().tobytes())
        readings, memory = touch.step(state, memory, reset)
        lines.append(readings["a"].flatten().numpy())
    command = [str(tmp_path / "build" / "touch"), str(tmp_path / "hand.aoti.pt2"), str(tmp_path), str(num_envs), "5"]
    subprocess.run(command, check=True, capture_output=True)
    readings_cpp = np.fromfile(tmp_path / "reading_a.bin", np.float32)
    expected = np.concatenate(lines)
    assert np.abs(readings_cpp - expected).max() <= 1e-5 * np.abs(expected).max()

"""Runs an exported step on recorded inputs, in a process that cannot import tgdsl: `python standalone.py FILE RECORDS`.

Prints as JSON by output the largest difference from the recorded one, and whether tensors of a wrong dtype are refused. It is
also an example of how to call each format.
"""

import json
import sys
import zipfile
from collections.abc import Callable, Sequence

import numpy as np

Arrays = list[np.ndarray]


def signature_text(file: str) -> str:
    """Return the text that says what goes in and comes out."""
    if file.endswith(".onnx"):
        import onnxruntime

        return onnxruntime.InferenceSession(file).get_modelmeta().custom_metadata_map["tgdsl"]
    with zipfile.ZipFile(file) as archive:
        return archive.read(next(name for name in archive.namelist() if name.endswith("/extra/tgdsl.json"))).decode()


def loaded(file: str, inputs: Sequence[str]) -> Callable[[Arrays], Arrays]:
    """Return a function of an exported file: inputs in order to outputs in order."""
    if file.endswith(".onnx"):
        import onnxruntime

        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        return lambda arrays: [np.asarray(out) for out in session.run(None, dict(zip(inputs, arrays, strict=True)))]
    import torch

    with zipfile.ZipFile(file) as archive:
        is_compiled = any(name.endswith(".so") for name in archive.namelist())
    load = torch._inductor.aoti_load_package if is_compiled else lambda path: torch.export.load(path).module()
    program = load(file)

    def call(arrays: Arrays) -> Arrays:
        with torch.no_grad():
            return [tensor.numpy() for tensor in program(*map(torch.from_numpy, arrays))]

    return call


def differences(program: Callable[[Arrays], Arrays], signature: dict, record: str) -> dict[str, float]:
    """Return by output the largest difference, over the largest magnitude of its channel, where memory is carried through."""
    calls = np.load(record)
    inputs, outputs = signature["inputs"], [port["name"] for port in signature["outputs"]]
    num_calls, num_envs = int(calls["num_calls"]), int(calls["num_envs"])
    memory = {
        port["name"]: np.full((num_envs, *port["shape"]), port["rest"], port["dtype"])
        for port in inputs
        if port["name"].startswith("memory/")
    }
    error: dict[str, np.ndarray] = {}
    scale: dict[str, np.ndarray] = {}
    for call in range(num_calls):
        arguments = [memory[p["name"]] if p["name"] in memory else calls[f"{call}/{p['name']}"] for p in inputs]
        result = dict(zip(outputs, program(arguments), strict=True))
        memory = {f"memory/{name[5:]}": value for name, value in result.items() if name.startswith("next/")}
        for name in (name for name in outputs if not name.startswith("next/")):
            actual, expected = result[name].astype(np.float64), calls[f"{call}/{name}"].astype(np.float64)
            if not np.array_equal(np.isnan(actual), np.isnan(expected)):
                raise SystemExit(f"{name}: other numbers are NaN at call {call} of {num_envs} environments")
            axes = tuple(range(actual.ndim - name.startswith("reading/")))
            largest = [np.nanmax(np.abs(x), axis=axes, initial=0.0) for x in (actual - expected, expected)]
            error[name] = np.maximum(error.get(name, 0.0), largest[0])
            scale[name] = np.maximum(scale.get(name, 0.0), largest[1])
    return {name: float(np.max(error[name] / np.where(scale[name] > 0, scale[name], 1.0), initial=0.0)) for name in error}


def refuses_other_dtypes(program: Callable[[Arrays], Arrays], signature: dict) -> bool:
    """Return whether the first input is refused in double or single precision, whichever is not its own."""
    first, *rest = [np.zeros((2, *port["shape"]), port["dtype"]) for port in signature["inputs"]]
    wrong = first.astype(np.float32 if first.dtype == np.float64 else np.float64)
    try:
        program([wrong, *rest])
    except Exception:  # each runtime raises its own
        return True
    return False


if __name__ == "__main__":
    sys.modules["tgdsl"] = None  # type: ignore[assignment]  # importing it raises ImportError
    file, *records = sys.argv[1:]
    signature = json.loads(signature_text(file))
    program = loaded(file, [port["name"] for port in signature["inputs"]])
    answer = {"differences": [differences(program, signature, record) for record in records]}
    print(json.dumps({**answer, "refuses": refuses_other_dtypes(program, signature)}))

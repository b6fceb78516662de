"""Compare the module's component planes with the same equations in 3-vectors, eager and compiled.

    python benchmarks/module.py [--device cuda] [--num-envs 1024] [--repeats 30]

Reads random states by `kinematic_taxel` (force and torque) on a 10 × 10 pad and on the XHand1 (199 taxels). The readings of
both must agree; then calls alternate, and medians and their ratio are printed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from torch import Tensor

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

PAD = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .005"/></body>
  <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""


@dataclass(frozen=True)
class Options:
    """Command-line options."""

    device: str = "cpu"
    num_envs: int = 1024
    repeats: int = 30
    """Timed calls of each variant."""


def pad_module(device: str) -> TactileModule:
    """Return `kinematic_taxel` on a 10 × 10 pad under a cube."""
    grid = {"method": "grid", "rows": 10, "columns": 10, "direction": [0, 0, -1], "radius": 0.004}
    with TemporaryDirectory() as folder:
        model = Path(folder) / "pad.xml"
        model.write_text(PAD)
        document = {
            "tgdsl": 1,
            "robot": {"model": str(model), "layout": {"resolutions": {"r": {"pad": grid}}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"touch": {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"]}},
        }
        return tgdsl.compile(document, device=device)


def hand_module(device: str) -> TactileModule:
    """Return `kinematic_taxel` on the XHand1 at medium resolution, with a cube on its palm."""
    example = Path(__file__).parent.parent / "examples" / "xhand1_palm.yaml"
    only_touch = {"sensors": "{touch: {kind: kinematic_taxel, links: hand, feels: [cube]}}", "observations": "{}"}
    return tgdsl.compile(example, overrides=only_touch, device=device)


def rotation_matrix(quat: Tensor) -> Tensor:
    """Return the matrices (…, 3, 3) of unit quaternions (…, 4)."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


class VectorTaxels(torch.nn.Module):
    """The kinematic taxel against one centred box, with 3-vectors in the last axis and 3 × 3 products."""

    def __init__(self, touch: TactileModule):
        """Take the constants of a module whose only sensor is `touch`."""
        super().__init__()
        plan, device = touch.plan, touch.device
        layout = plan.layout_of(plan.sensors[0])
        bodies = plan.inputs.bodies
        links = [bodies.index(layout.links[i].body) for i in layout.link_id]
        pair_of = {pair.link: i for i, pair in enumerate(plan.inputs.pairs)}
        self.link = torch.tensor(links, device=device)
        self.pair = torch.tensor([pair_of[layout.links[i].body] for i in layout.link_id], device=device)
        self.cube = bodies.index("cube")
        self.pos = torch.tensor(layout.pos, dtype=torch.float32, device=device)
        self.radius = torch.tensor(layout.radius, dtype=torch.float32, device=device)
        (geoms,) = plan.quantities["contact_depth"].geoms
        self.half_size = torch.tensor(geoms.size[0, 0], dtype=torch.float32, device=device)

    def forward(self, pos: Tensor, quat: Tensor, linvel: Tensor, angvel: Tensor, contact_found: Tensor) -> Tensor:
        """Return force and torque (env, taxel, 6)."""
        rotation = rotation_matrix(quat)
        link, cube = rotation[:, self.link], rotation[:, self.cube, None]
        arm = (link @ self.pos[:, :, None]).squeeze(-1)
        point = pos[:, self.link] + arm
        from_cube = point - pos[:, self.cube, None]
        local = (cube.transpose(-1, -2) @ from_cube[..., None]).squeeze(-1)
        beyond = local.abs() - self.half_size
        outside = beyond.clamp(min=0).norm(dim=-1)
        inside = beyond.amax(dim=-1)
        sign = torch.where(local < 0, -1.0, 1.0)
        face = torch.nn.functional.one_hot(beyond.argmax(dim=-1), 3)
        gradient = sign * torch.where(outside[..., None] > 0, beyond.clamp(min=0) / outside[..., None].clamp(min=1e-15), face)
        depth = (self.radius - torch.where(outside > 0, outside, inside)).clamp(min=0) * (contact_found[:, self.pair] > 0)
        normal = (link.transpose(-1, -2) @ cube @ gradient[..., None]).squeeze(-1) * (depth > 0)[..., None]
        cube_velocity = linvel[:, self.cube, None] + torch.linalg.cross(angvel[:, self.cube, None].expand_as(point), from_cube)
        link_velocity = linvel[:, self.link] + torch.linalg.cross(angvel[:, self.link], arm)
        velocity = (link.transpose(-1, -2) @ (cube_velocity - link_velocity)[..., None]).squeeze(-1) * (depth > 0)[..., None]
        turn = (link.transpose(-1, -2) @ (angvel[:, self.cube, None] - angvel[:, self.link])[..., None]).squeeze(-1)
        strength = depth[..., None] ** 1.2
        along = (velocity * normal).sum(-1, keepdim=True) * normal
        force = 500.0 * strength * normal + strength * along + 2.0 * (velocity - along)
        spin = 2.0 * (turn * normal).sum(-1, keepdim=True) * normal
        return torch.cat([force, torch.linalg.cross(self.pos.expand_as(force), force) + spin], dim=-1)


def median_ms(calls: dict[str, Callable[[], Any]], repeats: int, device: str) -> dict[str, float]:
    """Return the median times of alternating calls [ms]; a drift of the machine affects all of them."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    with torch.no_grad():
        for i in range(repeats + 3):
            for name, call in calls.items():
                if device == "cuda":
                    torch.cuda.synchronize()
                start = time.perf_counter()
                call()
                if device == "cuda":
                    torch.cuda.synchronize()
                if i >= 3:
                    times[name].append(time.perf_counter() - start)
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def compare(name: str, touch: TactileModule, options: Options) -> None:
    """Check and time both formulations on a module."""
    state = touch.example_state(options.num_envs, dtype=torch.float32)
    fields = ("body_pos", "body_quat", "body_linvel", "body_angvel", "contact_found")
    tensors = [getattr(state, field) for field in fields]
    vectors = VectorTaxels(touch)
    compiled = TactileModule(touch.plan).to(options.device).compile()
    compiled_vectors = torch.compile(vectors, fullgraph=True, dynamic=True)
    expected = vectors(*tensors)
    with torch.no_grad():
        for readings in (touch(state)["touch"], compiled(state)["touch"], compiled_vectors(*tensors)):
            error = ((readings - expected).abs().amax((0, 1)) / expected.abs().amax((0, 1))).max()
            # 1e-4: the 3-vectors are differences of float32 positions in the world, which loses a digit.
            assert error < 1e-4, f"the two formulations differ by {error:.1e} of full scale"
    calls = {
        "planes, eager": lambda: touch(SceneState(*tensors)),
        "vectors, eager": lambda: vectors(*tensors),
        "planes, compiled": lambda: compiled(SceneState(*tensors)),
        "vectors, compiled": lambda: compiled_vectors(*tensors),
    }
    times = median_ms(calls, options.repeats, options.device)
    share = float((expected[..., :3].norm(dim=-1) > 0).float().mean())
    print(f"\n{name}: {options.num_envs} environments × {expected.shape[1]} taxels, {share:.0%} in contact")
    for key, value in times.items():
        print(f"  {key:<20}{value:9.3f} ms")
    for mode in ("eager", "compiled"):
        print(f"  vectors / planes, {mode:<10}{times[f'vectors, {mode}'] / times[f'planes, {mode}']:6.2f}")


def main(options: Options) -> None:
    """Compare on the pad and on the hand."""
    machine = torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {machine}, medians of {options.repeats}")
    compare("pad", pad_module(options.device), options)
    torch.compiler.reset()
    compare("xhand1", hand_module(options.device), options)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

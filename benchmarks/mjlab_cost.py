"""Measure the cost of touch in mjlab: the time of a control step of environments with and without the sensor.

    python benchmarks/mjlab_cost.py --device cuda:0 --envs 8192   # mjlab captures its physics steps itself
    python benchmarks/mjlab_cost.py --device cpu --envs 16

Needs tgdsl and mjlab, but no network: `pip install --no-index --find-links WHEELS tgdsl mjlab`. The scene is that of the task
Tgdsl-In-Palm-Rotate: an XHand1 with 199 taxels of `kinematic_taxel` and a cube. The share is (with − without) / with, from
medians of alternating blocks of steps.

- `eager`: `TouchSensorCfg(graph=False)`, the module uncompiled
- `graph`: `TouchSensorCfg()` on a GPU: the compiled module, replayed with the reading of the scene in one CUDA graph
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace

import torch


def environment(num_envs: int, device: str, touch: str | None):
    """Return environments of the task from the same seed, with "eager" or "graph" touch or without; nothing resets them."""
    from mjlab.envs import ManagerBasedRlEnv  # pyright: ignore[reportMissingImports]

    from tgdsl.adapters.mjlab_tasks import env_cfg

    cfg = env_cfg()
    cfg.scene.num_envs, cfg.terminations, cfg.seed = num_envs, {}, 0
    cfg.scene.sensors = tuple(replace(sensor, graph=touch == "graph") for sensor in cfg.scene.sensors if touch is not None)
    if touch is None:
        for group in cfg.observations.values():
            del group.terms["touch"]
    env = ManagerBasedRlEnv(cfg, device=device)
    env.reset()
    return env


def seconds_per_step(env, steps: int) -> float:
    action = torch.zeros((env.num_envs, env.action_manager.total_action_dim), device=env.device)
    _wait(env.device)
    start = time.perf_counter()
    for _ in range(steps):
        env.step(action)
    _wait(env.device)
    return (time.perf_counter() - start) / steps


def _wait(device) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--envs", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=50, help="control steps of a block")
    parser.add_argument("--blocks", type=int, default=5)
    options = parser.parse_args()
    bare = environment(options.envs, options.device, None)
    rows: dict[str, dict[str, float]] = {}
    for touch in ("eager", "graph") if torch.device(options.device).type == "cuda" else ("eager",):
        with_sensor = environment(options.envs, options.device, touch)
        for env in (bare, with_sensor):
            seconds_per_step(env, max(5, options.steps // 5))
        blocks = [[seconds_per_step(env, options.steps) for env in (bare, with_sensor)] for _ in range(options.blocks)]
        plain, with_touch = (statistics.median(column) for column in zip(*blocks, strict=True))
        rows[touch] = {"without_ms": 1e3 * plain, "with_ms": 1e3 * with_touch, "share": 1 - plain / with_touch}
    num_taxels = with_sensor.scene["touch"].touch.plan.layout.num_taxels
    print(f"{options.envs} environments, {num_taxels} taxels, {options.device}, control step {with_sensor.step_dt:g} s")
    for name, row in rows.items():
        print(f"{name:<10}{row['without_ms']:9.3f} ms without{row['with_ms']:9.3f} ms with   share {row['share']:.1%}")
    print(json.dumps({"envs": options.envs, "taxels": num_taxels, "device": options.device, "rows": rows}))


if __name__ == "__main__":
    main()

"""What touch costs in mjlab: time of a control step of an environment with the sensor, and of the same one without.

    python benchmarks/mjlab_cost.py --device cuda:0 --envs 8192   # mjlab captures its physics steps by itself
    python benchmarks/mjlab_cost.py --device cpu --envs 16

Needs tgdsl and mjlab, and no network: `pip install --no-index --find-links WHEELS tgdsl mjlab`. The scene is that of the task
Tgdsl-In-Palm-Rotate, an XHand1 with 199 taxels of `kinematic_taxel` and a cube. The share is (with − without) / with, by the
medians of alternating blocks of steps.

- `eager`: the module as the adapter reads it
- `compiled`: the same after `torch.compile`
- `captured`: one CUDA graph of the module's step by itself, at a state that was read before
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import torch

from tgdsl.module.calls import captured


def environment(num_envs: int, device: str, has_touch: bool):
    """Return environments of the task, with the sensor or without, that begin alike; nothing ends or resets them."""
    from mjlab.envs import ManagerBasedRlEnv  # pyright: ignore[reportMissingImports]

    from tgdsl.adapters.mjlab_tasks import env_cfg

    cfg = env_cfg()
    cfg.scene.num_envs, cfg.terminations, cfg.seed = num_envs, {}, 0
    if not has_touch:
        cfg.scene.sensors = ()
        for group in cfg.observations.values():
            del group.terms["touch"]
    env = ManagerBasedRlEnv(cfg, device=device)
    env.reset()
    return env


def seconds_per_call(call: Callable[[], object], device: str, calls: int) -> float:
    wait(device)
    start = time.perf_counter()
    for _ in range(calls):
        call()
    wait(device)
    return (time.perf_counter() - start) / calls


def seconds_per_step(env, steps: int) -> float:
    action = torch.zeros((env.num_envs, env.action_manager.total_action_dim), device=env.device)
    return seconds_per_call(lambda: env.step(action), env.device, steps)


def wait(device) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def captured_seconds(env, steps: int) -> float:
    """Return the time of one replay of the module's step as a CUDA graph, at the state where the environments are."""
    sensor = env.scene["touch"]
    touch, state = sensor.touch, sensor._state()
    state.dt = env.step_dt
    memory = touch.initial_memory(env.num_envs, env.step_dt)
    with torch.no_grad():
        replay, _ = captured(lambda: touch.step(state, memory)[0])
    return seconds_per_call(replay, env.device, steps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--envs", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=50, help="control steps of a block")
    parser.add_argument("--blocks", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true", help="leave out the row `compiled`")
    options = parser.parse_args()
    without, touched = (environment(options.envs, options.device, has_touch) for has_touch in (False, True))
    num_taxels = touched.scene["touch"].touch.plan.layout.num_taxels
    rows: dict[str, dict[str, float]] = {}
    for name in ("eager",) if options.no_compile else ("eager", "compiled"):
        if name == "compiled":
            touched.scene["touch"].touch.compile()
        for env in (without, touched):
            seconds_per_step(env, max(3, options.steps // 5))
        blocks = [[seconds_per_step(env, options.steps) for env in (without, touched)] for _ in range(options.blocks)]
        plain, felt = (statistics.median(column) for column in zip(*blocks, strict=True))
        rows[name] = {"without_ms": 1e3 * plain, "with_ms": 1e3 * felt, "share": (felt - plain) / felt}
    if torch.device(options.device).type == "cuda":
        plain, module = next(iter(rows.values()))["without_ms"], 1e3 * captured_seconds(touched, options.steps)
        rows["captured"] = {"without_ms": plain, "with_ms": plain + module, "share": module / (plain + module)}
    print(f"{options.envs} environments, {num_taxels} taxels, {options.device}, control step {touched.step_dt:g} s")
    for name, row in rows.items():
        print(f"{name:<10}{row['without_ms']:9.3f} ms without{row['with_ms']:9.3f} ms with   share {row['share']:.1%}")
    print(json.dumps({"envs": options.envs, "taxels": num_taxels, "device": options.device, "rows": rows}))


if __name__ == "__main__":
    main()

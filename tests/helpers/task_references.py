"""Rewards, ends and scores of tasks and the rates of shared terms, in float64 NumPy: what their classes are compared with.

A function of a task yields its own terms without weights, `is_over` and `score` of each step of one environment, given the
spec, a record (one row per instant, the first that at the start) and the control step dt [s].
"""

import math

import numpy as np

from tgdsl.rl import terms

QUARTER, UPRIGHT = 0.5 * math.pi, math.radians(20.0)


def pay(spec, link_force: np.ndarray, fingers: np.ndarray) -> float:
    """Return what progress pays at one instant of one environment.

    Args:
        spec: What progress pays.
        link_force: The object's force on each link, (link, 3) [N].
        fingers: Which links are fingers, (link,).
    """
    is_loaded = np.linalg.norm(link_force, axis=1) >= spec.load
    return 1.0 if is_loaded.sum() >= spec.links and (is_loaded & fingers).any() else spec.coasting_pay


def paid_rate(spec, rate: float) -> float:
    """Return what pays of a rate of progress [rad/s]."""
    bounded = min(rate, spec.max_spin)
    bounded = bounded if spec.min_spin is None else max(bounded, spec.min_spin)
    return bounded if bounded >= 0 else spec.backward * bounded


def dropped(spec, pos: np.ndarray, start: np.ndarray) -> bool:
    """Whether an object at a place is lost, that started at another [m]."""
    away = np.linalg.norm(pos - start) if spec.drop_measure == "distance" else start[2] - pos[2]
    return bool(away > spec.drop_distance)


def in_palm_rotate(spec, record, dt):
    # The record has `pos` [m], `quat`, `link_force` (step, link, 3) [N]; and `fingers`, which links are fingers
    way, pos, quat = (1.0 if spec.direction == "counterclockwise" else -1.0), record["pos"], record["quat"]
    angle, reached, forth, paid = 0.0, 0, 0.0, 0.0
    for t in range(1, len(pos)):
        w, x, y, z = _quat_product(quat[t], quat[t - 1] * [1, -1, -1, -1])
        step = 2.0 * way * math.atan2(z if w >= 0 else -z, abs(w))
        angle += step
        w, x, y, z = _quat_product(quat[t], quat[0] * [1, -1, -1, -1])
        tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
        is_reached = (reached + 1) * QUARTER - angle < spec.goal_tolerance and tilt < spec.max_tilt
        reached += is_reached
        share_paid = pay(spec.hold, record["link_force"][t], record["fingers"])
        forth, paid = forth + max(0.0, step), paid + share_paid * max(0.0, step)
        share = paid / forth if forth else 1.0
        forth, paid = (0.0, 0.0) if is_reached else (forth, paid)
        distance = np.linalg.norm(pos[t] - pos[0])
        is_over = dropped(spec, pos[t], pos[0])
        pays = spec.spin_tilt is None or tilt <= spec.spin_tilt
        yield {
            "success": is_reached * share,
            "spin": pays * paid_rate(spec, step / dt) * (share_paid if step > 0 else 1.0),
            "tilt": tilt,
            "object_distance": max(0.0, distance - spec.free_distance),
            "drop": is_over,
            "is_over": is_over,
            "score": reached,
        }


def _quat_product(left: np.ndarray, right: np.ndarray):
    (a, *v), (b, *u) = left, right
    return np.concatenate([[a * b - np.dot(v, u)], a * np.array(u) + b * np.array(v) + np.cross(v, u)])


def in_hand_repose(spec, record, dt):
    # The record has `pos` [m] and `quat`; and `goal_axis` (goal, 3), axes of goals in turn, or `goal_angles` (goal, 2), angles
    # about x and then y [rad]; and `goal_steps`, control steps for each
    pos = record["pos"]
    rot = [_matrix(quat) for quat in record["quat"]]
    reached, near_since, goal_time = 0, 0, 0
    goal = _next_goal(spec, record, 0) @ rot[0]
    for t in range(1, len(pos)):
        error = _angle_between(goal, rot[t])
        near_since = near_since + 1 if error < spec.goal_tolerance else 0
        is_reached = near_since >= spec.goal_hold
        is_late = not is_reached and t - goal_time >= record["goal_steps"][reached]
        is_dropped = dropped(spec, pos[t], pos[0])
        row = {
            "success": is_reached,
            "track_gaussian": math.exp(-0.5 * (error / spec.track_width) ** 2),
            "track_inverse": 1 / (1 + (error / spec.track_half) ** 2),
            "progress": paid_rate(spec, (_angle_between(goal, rot[t - 1]) - error) / dt),
            "drop": is_dropped,
            "goal_timeout": is_late,
        }
        if is_reached:
            reached, near_since, goal_time = reached + 1, 0, t
            goal = _next_goal(spec, record, reached) @ goal
        yield row | {"is_over": is_dropped or is_late, "score": reached}


def _next_goal(spec, record, number: int) -> np.ndarray:
    if "goal_angles" in record:
        x, y = record["goal_angles"][number]
        return _turn(np.eye(3)[1], y) @ _turn(np.eye(3)[0], x)
    return _turn(record["goal_axis"][number], spec.goal_step)


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _matrix(quat: np.ndarray) -> np.ndarray:
    angle = 2 * math.atan2(np.linalg.norm(quat[1:]), quat[0])
    return _turn(quat[1:] / max(np.linalg.norm(quat[1:]), 1e-300), angle)


def _angle_between(one: np.ndarray, other: np.ndarray) -> float:
    return 2 * math.asin(min(1.0, np.linalg.norm(one - other) / math.sqrt(8)))


def screwdriver(spec, record, dt):
    # The record has `pos` [m], `quat`, `tip` [m], `joint_pos` [rad], `link_force` (step, link, 3) [N]; `upright_pos`,
    # `upright_tip` [m], where body and tip are in the keyframe; and `fingers`, which links are fingers
    quat, turned, angle, mark, since = record["quat"], 0.0, 0.0, 0.0, 0
    for t in range(1, len(quat)):
        step = -_turned_about_z(quat[t - 1], quat[t])
        _, x, y, _ = quat[t]
        tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
        turned += step * (tilt < UPRIGHT)
        distance = np.linalg.norm(record["pos"][t] - record["upright_pos"])
        away = np.linalg.norm(record["tip"][t] - record["upright_tip"])
        angle, since = angle + step, since + 1
        is_stalled = False
        if spec.stall is not None:
            mark, since = (angle, 0) if angle >= mark + spec.stall.turn else (mark, since)
            is_stalled = since >= round(spec.stall.within / dt)
        is_over = tilt > spec.drop_tilt or away > spec.engagement or is_stalled
        share_paid = pay(spec.hold, record["link_force"][t], record["fingers"])
        yield {
            "spin": paid_rate(spec, step / dt) * (share_paid if step > 0 else 1.0),
            "alignment": 1.0 - math.cos(tilt),
            "object_distance": max(0.0, distance - spec.free_distance),
            "hand_pose": np.sum((record["joint_pos"][t] - record["joint_pos"][0]) ** 2),
            "drop": is_over,
            "is_over": is_over,
            "score": turned / spec.episode,
        }


def _turned_about_z(before: np.ndarray, after: np.ndarray) -> float:
    """Return by how much a body has turned about its own z between two orientations [rad]."""
    a, b, c, d = before
    w, x, y, z = after
    scalar, along = a * w + b * x + c * y + d * z, a * z - d * w - b * y + c * x  # of the conjugate of `before` times `after`
    return 2.0 * math.atan2(along if scalar >= 0 else -along, abs(scalar))


def grip_force(spec, record, dt):
    # The record has `pos` [m], `quat`, `normal_force` (step, link) [N], `command`, as observed then [N], and `is_new`,
    # whether that was drawn then
    since, squares = 0, []
    for t in range(1, len(record["pos"])):
        since += 1
        force = float(np.sum(record["normal_force"][t]))
        error = force / record["command"][t - 1] - 1.0
        if since * dt > spec.settling - 0.5 * dt:
            squares.append(error**2)
        since = 0 if record["is_new"][t] else since
        distance = float(np.linalg.norm(record["pos"][t] - record["pos"][0]))
        alike = min(1.0, abs(float(np.dot(record["quat"][t], record["quat"][0]))))
        is_dropped, is_crushed = distance > spec.drop_distance, force > spec.max_force
        yield {
            "force_near": math.exp(-((error / spec.force_width) ** 2)),
            "force_far": max(0.0, 1.0 - abs(error)),
            "object_distance": max(0.0, distance - spec.free_distance),
            "object_angle": 2.0 * math.acos(alike),
            "drop": is_dropped,
            "crush": is_crushed,
            "is_over": is_dropped or is_crushed,
            "score": math.sqrt(np.mean(squares)) if squares else 1.0,
        }


def hot_ball(spec, record, dt):
    # The record has `pos`, of the hot ball [m], `link_force`, of it on fingertips (step, link, 3) [N], `distance` [m],
    # and `heat`, what grids read (step, cell) [°C]
    is_latched, score = False, 0.0
    for t in range(1, len(record["pos"])):
        # The largest of clamped progresses is that of the hottest cell.
        progress = (record["heat"][t].max() - spec.ambient) / (spec.target - spec.ambient)
        progress = min(1.0, max(0.0, float(progress)))
        is_latched = is_latched or progress >= 1.0 - spec.margin
        is_touched = bool(np.linalg.norm(record["link_force"][t], axis=1).max() >= spec.min_force)
        score += dt * (is_latched and is_touched)
        is_over = bool(record["pos"][t][2] < spec.lost_height)
        yield {
            "approach": math.exp(-max(0.0, record["distance"][t].min()) / spec.near_width),
            "contact": is_touched,
            "progress": progress,
            "latched": is_latched and is_touched,
            "lost": is_over,
            "is_over": is_over,
            "score": score,
        }


def _action_rate(term, row):
    return np.sum((row["action"] - row["last_action"]) ** 2)


def _joint_limit(term, row):
    middle, half = 0.5 * (row["low"] + row["high"]), 0.5 * (row["high"] - row["low"])
    return np.sum(np.maximum(abs(row["joint_pos"] - middle) - 0.95 * half, 0.0))


def _work(term, row):
    return np.sum(np.abs(row["torque"] * row["joint_vel"]))


def _effort(term, row):
    return np.sum((row["torque"] / row["max_torque"]) ** 2)


def _contact_force(term, row):
    return sum(max(0.0, np.linalg.norm(f) - term.max_force) / term.max_force for f in row["link_force"])


def _near(term, row):
    return np.mean(np.exp(-np.maximum(np.sort(row["distance"])[: term.nearest], 0.0) / term.width))


def _object_speed(term, row):
    speed, spin = np.linalg.norm(row["linvel"]), np.linalg.norm(row["angvel"])
    return max(0.0, speed / term.free_speed - 1.0) + max(0.0, spin / term.free_spin - 1.0)


TERMS = {
    terms.ActionRate: _action_rate,
    terms.JointLimit: _joint_limit,
    terms.Work: _work,
    terms.Effort: _effort,
    terms.ContactForce: _contact_force,
    terms.Near: _near,
    terms.ObjectSpeed: _object_speed,
}
"""Rate of a shared term at one instant: fields of `Now`, and `low`, `high` and `max_torque` of `Setup`."""

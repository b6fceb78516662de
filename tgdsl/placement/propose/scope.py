"""Which of what may be a hand are taken for hands, and which links a layout leaves out: an arm, a forearm, a base, a head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.placement.propose.flexion import Flexion
from tgdsl.placement.propose.front import PalmFront
from tgdsl.placement.propose.hands import KinematicTree, free_standing, hands
from tgdsl.placement.propose.jaws import with_jaws
from tgdsl.placement.propose.limits import with_assumed_limits
from tgdsl.schema.select import matching

BEFORE = "before the link from which the fingers part; --include adds it"
BESIDE = "no part of a hand; --include adds it"
NO_LIMITS = "no joint of the hand has limits: its hinges are taken to turn by 30 deg to either side"
SCENERY = "stands or floats by itself: taken for scenery or an object; --include adds it"


def chosen_hands(tree: KinematicTree) -> list[Flexion]:
    """Return the hands of a robot: those of which two chains or a jaw are known to close, or else all that may be one.

    Where none is known to close, hinges without limits are tried within assumed ones.
    """
    results = [Flexion(tree, own) for hand in hands(tree) for own in with_jaws(tree, hand)]
    closing = _that_close(results)
    if not closing:
        free = replace(tree, model=with_assumed_limits(tree.model), doubt=NO_LIMITS)
        closing = _that_close([Flexion(free, hand) for hand in hands(free)])
    for flexion in closing:
        if flexion.hand.palm is not None:
            flexion.hand = replace(flexion.hand, mounts=PalmFront(flexion).mounts())
    return closing or results


def _that_close(flexions: Sequence[Flexion]) -> list[Flexion]:
    return [flexion for flexion in flexions if flexion.num_closing > (flexion.hand.jaw is None)]


def outside(tree: KinematicTree, found: Sequence[Flexion]) -> dict[int, str]:
    """Return the bodies with surface that are in no hand, and why a layout leaves them out."""
    within = {body for flexion in found for body in (*flexion.hand.mounts, *flexion.hand.fingers)}
    before = {s for flexion in found for s in tree.path(flexion.hand.base)[1:]}
    carrying = {b for flexion in found for m in flexion.hand.mounts for b in tree.within(flexion.hand.base, m)}
    scenery = set(free_standing(tree))
    is_before = {body: tree.segment[body] in before or body in carrying for body in sorted(tree.area)}
    reasons = {body: BEFORE if own else BESIDE for body, own in is_before.items()}
    return {body: SCENERY if body in scenery else why for body, why in reasons.items() if body not in within}


def included(patterns: Sequence[str], names: Sequence[str], left_out: Mapping[str, str]) -> set[str]:
    """Return the links that some patterns ask for.

    Args:
        patterns: Names of links, or shell wildcards.
        names: Links that can have taxels.
        left_out: Other links, and why they cannot.

    Raises:
        TgdslError: If a pattern matches no link that can have taxels.
    """
    result: set[str] = set()
    for pattern in patterns:
        own = {pattern} & {*names} or {*matching(pattern, names)}
        if not own:
            barred = [name for name in left_out if name == pattern or name in matching(pattern, [name])]
            why = [f'"{name}" can have no taxels: {left_out[name]}' for name in barred]
            problem = "; ".join(why) or f'no link matches "{pattern}"; {did_you_mean(pattern, names, "links")}'
            raise TgdslError(f"--include: {problem}")
        result |= own
    return result

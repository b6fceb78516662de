"""Students, one per type, placement, noise and seed, each in its block of environments; and their teacher.

Shapes: `feature` numbers of a group.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from tgdsl.errors import SpecError, TgdslError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.module.taxels import image_indices
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask, wrong_groups
from tgdsl.rl.playing.policy import (
    ACTOR_GROUPS,
    OF_TOUCH,
    Policy,
    PolicyError,
    changes_since,
    check_card,
    check_learned,
    read_policy,
)
from tgdsl.rl.sensors import GROUP, PolicyTouch, compile_sensors
from tgdsl.rl.spec import PushSpec, touch_types
from tgdsl.rl.students.spec import StudentNetworksSpec
from tgdsl.rl.students.student import Architecture, Encoder, Grid

NONE = "none"  # the type without touch


class StudentError(TgdslError):
    """Students that cannot be created or assigned to environments."""


@dataclass(frozen=True)
class StudentKey:
    """A student: its touch (None: without), and the seed of its initial weights."""

    touch: PolicyTouch | None
    seed: int

    @property
    def kind(self) -> tuple[str, str, str]:
        """Type, placement and noise; the latter two are empty without touch."""
        return (NONE, "", "") if self.touch is None else (self.touch.type, self.touch.placement, self.touch.noise)

    @property
    def name(self) -> str:
        """Name of its files and columns, such as `depth-hand-clean-s0`."""
        return "-".join([*(part for part in self.kind if part), f"s{self.seed}"]).replace("*", "_").replace("/", "_")


def student_keys(types: Sequence[str], placements: Sequence[str], noises: Sequence[str], seeds: int) -> list[StudentKey]:
    """Return a student per type, placement, noise and seed; without touch, one per seed."""
    all_types = [NONE, *touch_types()]
    selected = [name for type_ in types for name in (all_types if type_ == "all" else [type_])]
    for name in selected:
        if name not in all_types:
            raise StudentError(f'there is no type "{name}"; {did_you_mean(name, all_types, "types")}')
    for option, names in (("types", selected), ("placements", placements), ("noise", noises)):
        if len(set(names)) < len(names):
            raise StudentError(f"{option} {', '.join(names)}: one is named twice")
        if not names:
            raise StudentError(f"{option}: expected one at least")
    if seeds < 1:
        raise StudentError(f"{seeds} seeds, expected 1 at least")
    touches = [
        None if type_ == NONE else PolicyTouch(type_, placement, noise)
        for type_ in selected
        for placement in placements
        for noise in noises
    ]
    keys = {}
    for key in (StudentKey(touch, seed) for touch in dict.fromkeys(touches) for seed in range(seeds)):
        if (other := keys.setdefault(key.name, key)) is not key:
            both = " and ".join(" ".join(part for part in each.kind if part) for each in (other, key))
            raise StudentError(f"two students would have the name {key.name}: {both}")
    return list(keys.values())


def touches(dealt: Sequence[StudentKey], also: PolicyTouch | None = None) -> list[PolicyTouch]:
    """Return the touch of all students and a teacher (`also`), each once."""
    return list(dict.fromkeys(touch for touch in (*(key.touch for key in dealt), also) if touch is not None))


def check_blocks(num_envs: int, num_students: int, num_variants: int) -> None:
    """Check that environments divide into blocks with equal numbers of all variants of the object."""
    unit = num_students * num_variants
    if num_envs % unit:
        of = f", {num_variants} variants of the object in the environments of each" if num_variants > 1 else ""
        lower, upper = num_envs // unit * unit, (num_envs // unit + 1) * unit
        near = f"{lower} or {upper}" if lower else f"{upper}"
        raise StudentError(f"{num_envs} environments do not divide among {num_students} students{of}: expected {near}")


def groups_of(loaded: LoadedTask, groups: Mapping[str, int]) -> list[str]:
    """Return the groups of observations that all students see, with `tactile_sensors` at the place of touch."""
    named = loaded.spec.distill.groups
    other_groups = [name for name in groups if not name.startswith(f"{GROUP}/")]
    if problems := wrong_groups(loaded.source, {("distill", "groups"): named}, other_groups):
        raise SpecError(problems)
    if named:
        return [*named, GROUP]
    return [name for name in ACTOR_GROUPS if name in groups or name == GROUP]


def seen_by(key: StudentKey, names: Sequence[str]) -> list[str]:
    """Return the groups of observations that a student sees, in their order."""
    touch_group = [key.touch.group] if key.touch else []
    return [group for name in names for group in (touch_group if name == GROUP else [name])]


def architecture(loaded: LoadedTask, env: TouchEnv, key: StudentKey, names: Sequence[str]) -> Architecture:
    """Return a student's networks: students with equal networks are stacked."""
    networks, parts, gates = loaded.spec.distill.networks, [], None
    for place, name in enumerate(seen_by(key, names)):
        size = env.groups[name]
        if key.touch is not None and name == key.touch.group:
            source = env.touch_sources[name]
            encoder = _touch_encoder(networks, key.touch, source.layout, size)
            if loaded.spec.distill.gates is not None:
                rows = next(output.rows for output in env.touch.outputs if output.name == source.spec.of)
                if key.touch.is_per_link or rows != "taxel":
                    problem = f"students with {key.touch.type} see no numbers of each taxel, which gates multiply"
                    raise loaded.error(("distill", "gates"), problem, "leave them out of --types")
                gates = place, source.layout.num_taxels
                if loaded.spec.distill.gates.taxels >= gates[1]:
                    problem = f"{key.touch.type} at {key.touch.placement} has {gates[1]} taxels, so no gate would close"
                    raise loaded.error(("distill", "gates", "taxels"), problem, "give fewer")
        else:
            encoder = Encoder(networks.kind, networks.encoder.hidden, networks.encoder.size)
        parts.append((size, encoder))
    heads = tuple(decoder.hidden for decoder in loaded.spec.distill.decoders.values())
    return Architecture(tuple(parts), networks.hidden, env.num_actions, heads, gates, networks.eps, networks.clip)


def _touch_encoder(networks: StudentNetworksSpec, touch: PolicyTouch, layout: Layout, size: int) -> Encoder:
    widths, kind = networks.touch_encoder, networks.touch_kind
    if kind in ("cnn", "convrnn") and not touch.is_per_link and layout.num_taxels and size % layout.num_taxels == 0:
        return Encoder(
            kind, networks.convolution.channels, widths.size, networks.convolution.kernel, grid_of(layout, size, touch)
        )
    return Encoder("lstm" if kind in ("lstm", "convrnn") else "mlp", widths.hidden, widths.size)


def grid_of(layout: Layout, size: int, touch: PolicyTouch) -> Grid:
    """Return the places of a group's taxels in images; raise `StudentError` if a link's taxels are on no grid."""
    try:
        images = image_indices(layout)
    except TgdslError as error:
        raise StudentError(f"{touch.group}: {error}; take networks.touch_kind mlp") from error
    if missing := [link.name for link in layout.links if link.name not in images]:
        problem = f"the taxels of {', '.join(missing)} are on no grid, and have no image"
        raise StudentError(f"{touch.group}: {problem}; take networks.touch_kind mlp")
    shape = (len(images), max(len(image) for image in images.values()), max(image.shape[1] for image in images.values()))
    cells = np.full(shape, -1, dtype=np.int64)
    for link, image in enumerate(images.values()):
        cells[link, : image.shape[0], : image.shape[1]] = image
    return Grid(size // layout.num_taxels, layout.num_taxels, shape, tuple(cells.ravel().tolist()))


WARM_CALLS = 3  # calls in which TorchScript optimises a policy before its capture on a GPU


class Teacher:
    """A learned policy, checked against this task: its file, its card, and its touch (None: without)."""

    def __init__(self, file: Path, loaded: LoadedTask):
        """Read it, and check that it is for this task and these actions."""
        self.saved, self._loaded = read_policy(file), loaded
        card = self.saved.card
        if card is None:
            raise PolicyError(f"{file}: this policy has no card that says how it was learned, as `tgdsl train` writes it")
        check_learned(card, file, loaded.spec, "teacher")
        self.card, theirs, ours = card, card["spec"], loaded.spec.model_dump(mode="json")
        self.touch = PolicyTouch(theirs["touch"], theirs["placement"], theirs["noise"]) if GROUP in card["groups"] else None
        if self.touch and theirs["resolution"] != ours["resolution"]:
            resolutions = f"resolution {theirs['resolution']}, here {ours['resolution']}"
            raise PolicyError(f"{file}: this teacher feels with other taxels: {resolutions}")
        if self.touch and theirs.get("temporal", "last") != ours["temporal"]:
            readings = f"temporal {theirs.get('temporal', 'last')}, here {ours['temporal']}"
            raise PolicyError(f"{file}: this teacher feels other readings of a control step: {readings}")
        if loaded.spec.distill.loss == "inverse_variance" and not card.get("std"):
            problem = "its card has no deviations of actions, `std`, which distill.loss inverse_variance divides by"
            raise PolicyError(f"{file}: {problem}; learn it again, or take distill.loss=mse")
        self.changes = changes_since(card, loaded.spec, OF_TOUCH)

    def check_taxels(self) -> None:
        """Raise `PolicyError` if a teacher with touch was learned with other taxels."""
        if self.touch is not None:
            touch = compile_sensors(own_task(self._loaded, self.touch), "cpu").touch
            check_card(self.saved, self.card["joints"], touch)

    def bound(self, env: TouchEnv) -> Policy:
        """Return the policy for some environments."""
        card, file = self.card, self.saved.file
        if list(env.joint_names) != list(card["joints"]):
            moved = (", ".join(names) for names in (card["joints"], env.joint_names))
            raise PolicyError("{}: this teacher moves {}, not {}".format(file, *moved))
        groups = {}
        for name, size in card["groups"].items():
            group = self.touch.group if name == GROUP and self.touch else name
            if env.groups.get(group) != size:
                there = f"has {env.groups[group]} numbers, not {size}: probes or objects are others"
                problem = there if group in env.groups else "is not there"
                raise PolicyError(f'{file}: this teacher sees the group "{name}", which {problem}')
            groups[group] = size
        policy = Policy(self.saved, groups, env.num_envs, env.num_actions, env.device)
        zeros = {name: torch.zeros((env.num_envs, size), device=env.device) for name, size in groups.items()}
        for _ in range(WARM_CALLS):
            policy(zeros)
        policy.begin(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        return policy


def students_task(loaded: LoadedTask) -> LoadedTask:
    """Return the students' task: without pushes if its document says so."""
    if loaded.spec.distill.pushes:
        return loaded
    randomise = loaded.spec.randomise.model_copy(update={"push": PushSpec()})
    return dataclasses.replace(loaded, spec=loaded.spec.model_copy(update={"randomise": randomise}))


def own_task(loaded: LoadedTask, touch: PolicyTouch | None) -> LoadedTask:
    """Return the task of a policy with one kind of touch, in separate environments."""
    keys = {"touch": "none"} if touch is None else {"touch": touch.type, "placement": touch.placement, "noise": touch.noise}
    return dataclasses.replace(loaded, spec=loaded.spec.model_copy(update=keys))

"""The teacher: a learned policy with its card, which says what each student should have done."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.policy import OF_TOUCH, Policy, PolicyError, changes_since, check_card, check_learned, read_policy
from tgdsl.rl.sensed import GROUP, Felt, compile_sensed
from tgdsl.rl.spec import PushSpec

WARM_CALLS = 3  # calls in which TorchScript optimises a policy, before one is captured on a GPU


class Teacher:
    """A learned policy, seen to be of this task: its file, its card, and what it feels; None: nothing."""

    def __init__(self, file: Path, loaded: LoadedTask):
        """Read it, and see that it is for this task and these actions."""
        self.saved, self._loaded = read_policy(file), loaded
        card = self.saved.card
        if card is None:
            raise PolicyError(f"{file}: this policy has no card that says how it was learned, as `tgdsl train` writes it")
        check_learned(card, file, loaded.spec, "teacher")
        self.card, theirs, ours = card, card["spec"], loaded.spec.model_dump(mode="json")
        self.felt = Felt(theirs["touch"], theirs["placement"], theirs["noise"]) if GROUP in card["groups"] else None
        if self.felt and theirs["resolution"] != ours["resolution"]:
            resolutions = f"resolution {theirs['resolution']}, here {ours['resolution']}"
            raise PolicyError(f"{file}: this teacher feels with other taxels: {resolutions}")
        if self.felt and theirs.get("temporal", "last") != ours["temporal"]:
            readings = f"temporal {theirs.get('temporal', 'last')}, here {ours['temporal']}"
            raise PolicyError(f"{file}: this teacher feels other readings of a control step: {readings}")
        if loaded.spec.distill.loss == "inverse_variance" and not card.get("std"):
            problem = "its card has no deviations of actions, `std`, which distill.loss inverse_variance divides by"
            raise PolicyError(f"{file}: {problem}; learn it again, or take distill.loss=mse")
        self.changes = changes_since(card, loaded.spec, OF_TOUCH)

    def check_taxels(self) -> None:
        """See that a teacher that feels does so with the taxels that there are now; raise `PolicyError` if they are others."""
        if self.felt is not None:
            touch = compile_sensed(own_task(self._loaded, self.felt), "cpu").touch
            check_card(self.saved, self.card["joints"], touch)

    def bound(self, env: TouchEnv) -> Policy:
        """Return the policy for some environments."""
        card, file = self.card, self.saved.file
        if list(env.joint_names) != list(card["joints"]):
            moved = (", ".join(names) for names in (card["joints"], env.joint_names))
            raise PolicyError("{}: this teacher moves {}, not {}".format(file, *moved))
        groups = {}
        for name, size in card["groups"].items():
            group = self.felt.group if name == GROUP and self.felt else name
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
    """Return the task in which students are taught: without pushes if its document says so."""
    if loaded.spec.distill.pushes:
        return loaded
    randomise = loaded.spec.randomise.model_copy(update={"push": PushSpec()})
    return dataclasses.replace(loaded, spec=loaded.spec.model_copy(update={"randomise": randomise}))


def own_task(loaded: LoadedTask, felt: Felt | None) -> LoadedTask:
    """Return the task of a policy that feels one thing, in environments of its own."""
    touch = {"touch": "none"} if felt is None else {"touch": felt.type, "placement": felt.placement, "noise": felt.noise}
    return dataclasses.replace(loaded, spec=loaded.spec.model_copy(update=touch))

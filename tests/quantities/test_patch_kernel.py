"""The Triton kernel of patches, run on the CPU by Triton's interpreter, against the torch code in float64."""

import contact_patches
import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels

from tgdsl.quantities.patch import CONTACT_PATCH, patch

TOLERANCES = {"force": 2e-5, "area": 2e-8, "pos": 2e-5, "normal": 2e-5}
"""Some roundings of float32 of forces of 10 N, places some metres away, and points of 1 cm about them [N, m², m]."""


def check(case):
    """What the kernel finds is what the definition does."""
    exact, arguments = (contact_patches.arguments(case, dtype) for dtype in (torch.float64, torch.float32))
    assert CONTACT_PATCH.takes_kernel(*arguments), case
    expected, found = patch(*exact), CONTACT_PATCH(*arguments)
    for name, tolerance in TOLERANCES.items():
        part, other = (
            torch.stack(own) if isinstance(own, tuple) else own for own in (getattr(found, name), getattr(expected, name))
        )
        assert (part.double() - other).abs().max() <= tolerance, (case, name, (part.double() - other).abs().max())
    assert (found.force > 0).any() and (found.force == 0).any(), case
    assert (found.area > 0).any() == (contact_patches.CASES[case].slots > 2), case


def check_strange_numbers():
    """What is not a number comes out, in no other environment; so does the force of a contact without a normal."""
    contacts, sides, _ = contact_patches.arguments("four slots", torch.float32)
    pair, body = int(sides.pairs[1, 0]), int(sides.bodies[0])
    for name, place in (("force", (5, pair, 0, 1)), ("pos", (6, pair, 0, 0)), ("body_quat", (7, body, 2))):
        contacts, *rest = contact_patches.arguments("four slots", torch.float32)
        contacts.force[5:7] = contacts.normal[5:7] = 1.0
        getattr(contacts, name)[place] = torch.nan
        ours, theirs = CONTACT_PATCH(contacts, *rest), patch(contacts, *rest)
        found, wanted = (torch.stack([own.force, *own.pos]) for own in (ours, theirs))
        others = [env for env in range(contact_patches.NUM_ENVS) if env != place[0]]
        assert found[:, place[0]].isnan().any() and torch.equal(found.isnan(), wanted.isnan()), name
        assert not found[:, others].isnan().any(), name
    contacts, *rest = contact_patches.arguments("four slots", torch.float32)
    contacts.force[5], contacts.normal[5] = 1.0, 0.0
    assert CONTACT_PATCH(contacts, *rest).force[5].isnan().all() and patch(contacts, *rest).force[5].isnan().all()


def compare() -> None:
    """Make all comparisons: run where `TRITON_INTERPRET` is set."""
    use_kernels()
    for case in contact_patches.CASES:
        check(case)
    check_strange_numbers()


@pytest.mark.slow
@needs_triton
def test_the_kernel_is_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

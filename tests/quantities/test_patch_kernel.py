"""The Triton kernel of patches, run on the CPU by Triton's interpreter, against the torch code in float64."""

import contact_patches
import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels

from tgdsl.quantities.patch import CONTACT_PATCH, patch

TOLERANCES = {"force": 2e-5, "area": 2e-8, "pos": 2e-5, "normal": 2e-5}
"""Some float32 roundings of forces of 10 N, centres metres away and points within 1 cm of them [N, m², m]."""


def check(case):
    """Require that the kernel matches the definition."""
    exact, arguments = (contact_patches.arguments(case, dtype) for dtype in (torch.float64, torch.float32))
    assert CONTACT_PATCH.takes_kernel(*arguments), case
    expected, result = patch(*exact), CONTACT_PATCH(*arguments)
    for name, tolerance in TOLERANCES.items():
        actual, reference = (
            torch.stack(value) if isinstance(value, tuple) else value
            for value in (getattr(result, name), getattr(expected, name))
        )
        assert (actual.double() - reference).abs().max() <= tolerance, (case, name, (actual.double() - reference).abs().max())
    assert (result.force > 0).any() and (result.force == 0).any(), case
    assert (result.area > 0).any() == (contact_patches.CASES[case].slots > 2), case


def check_strange_numbers():
    """NaN comes out, only in its own environment; so does a contact without a normal."""
    contacts, sides, _ = contact_patches.arguments("four slots", torch.float32)
    pair, body = int(sides.pairs[1, 0]), int(sides.bodies[0])
    for name, index in (("force", (5, pair, 0, 1)), ("pos", (6, pair, 0, 0)), ("body_quat", (7, body, 2))):
        contacts, *rest = contact_patches.arguments("four slots", torch.float32)
        contacts.force[5:7] = contacts.normal[5:7] = 1.0
        getattr(contacts, name)[index] = torch.nan
        from_kernel, from_torch = CONTACT_PATCH(contacts, *rest), patch(contacts, *rest)
        result, expected = (torch.stack([patches.force, *patches.pos]) for patches in (from_kernel, from_torch))
        others = [env for env in range(contact_patches.NUM_ENVS) if env != index[0]]
        assert result[:, index[0]].isnan().any() and torch.equal(result.isnan(), expected.isnan()), name
        assert not result[:, others].isnan().any(), name
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
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

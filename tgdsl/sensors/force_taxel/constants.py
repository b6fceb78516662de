"""Numbers that `footprint`, its float64 reference and its Triton kernel share.

Functions, not a module's floats: torch.compile for dynamic shapes makes graph inputs of those. A kernel takes them as
`tl.constexpr` of its file.
"""


def unreached() -> float:
    """Return the weight of a taxel that the object does not reach [probe's radius of depth], for loads without depth."""
    return 1e-3


def damping() -> float:
    """Return the weight of a step's length against its effect on the shares [1].

    It bounds steps where taxels of hardly any share decide.
    """
    return 0.1


def no_force() -> float:
    """Return the force [N] below which a direction fades to zero."""
    return 1e-12


def wholly() -> float:
    """Return the largest κ of a contact from which on the skin captures all of its force [1]."""
    return 0.75

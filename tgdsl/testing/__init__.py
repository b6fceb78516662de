"""The conformance suite: tests that every sensor kind passes; the test class of a kind, your own too, inherits them.

    class TestMyKind(KindConformance):
        kind = MY_KIND
        parameters = {"stiffness": 100.0}

gives a kind all the tests below for its float64 `reference`. Its author adds the closed-form cases. One of the tests,
`test_compiled_equals_eager`, compiles kernels and takes long: `pytest -k "not compiled_equals_eager"` leaves it out.
"""

from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.accuracy.states import moved, only
from tgdsl.testing.conformance import (
    FAR_TOLERANCE,
    FLOAT32_TOLERANCE,
    FLOAT64_TOLERANCE,
    SCENE,
    KindConformance,
    conformance_document,
    conformance_points,
)
from tgdsl.testing.reference import assert_agrees, full_scale_error

__all__ = [
    "FAR_TOLERANCE",
    "FLOAT32_TOLERANCE",
    "FLOAT64_TOLERANCE",
    "SCENE",
    "KindConformance",
    "ReferenceModule",
    "assert_agrees",
    "conformance_document",
    "conformance_points",
    "full_scale_error",
    "moved",
    "only",
]

"""Which variants of a sensor match the document, and which `accuracy` may choose."""

from typing import Literal

import pytest

from tgdsl.fields.models import SpecModel
from tgdsl.module.accuracy.variants import is_free, is_taken, variants_of, written_of
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import Alternative


class Query(SpecModel):
    """How distances to a mesh are found."""

    query: Literal["sdf", "raycast"] = "sdf"
    spacing: float | None = None


SDF, RAYCAST = Alternative("sdf", {"query": "sdf"}), Alternative("raycast", {"query": "raycast"}, unused=("spacing",))
DEPTH = next(kind for kind in KINDS if kind.name == "contact_depth")


def variants_with(**queries: Query):
    return variants_of(
        DEPTH,
        "skin",
        DEPTH.spec.model_validate({"kind": "contact_depth", "links": "pad", "feels": ["cup"]}),
        queries,
        (SDF, RAYCAST),
    )


def test_a_query_is_the_documents_if_all_objects_use_it():
    """With a bowl by rays and a cup by a grid, it is neither."""
    assert [query.is_own for query in variants_with(cup=Query(), bowl=Query()).queries] == [True, False]
    assert [query.is_own for query in variants_with(cup=Query(), bowl=Query(query="raycast")).queries] == [False, False]
    assert variants_with(cup=Query()).queries[1].changes == {"objects.cup.query": "raycast"}
    assert variants_with(cup=Query(), bowl=Query()).queries[1].changes == {
        "objects.cup.query": "raycast",
        "objects.bowl.query": "raycast",
    }


def test_the_documents_variant_has_the_label_of_its_query():
    assert variants_with(cup=Query()).own.label == "sdf"
    assert variants_with(cup=Query(), bowl=Query(query="raycast")).own.label == "as written"
    assert variants_with(cup=Query()).own.is_own


@pytest.mark.parametrize(
    ("written", "free"),
    [
        ({}, {"sdf", "raycast"}),
        ({"query": "sdf"}, {"sdf"}),
        ({"query": "raycast"}, {"raycast"}),
        ({"spacing": 0.001}, {"sdf"}),  # which rays do not use
        ({"query": "raycast", "spacing": 0.001}, set()),
    ],
)
def test_values_of_the_document_are_not_changed(written, free):
    spec = Query.model_validate(written)
    assert {alternative.label for alternative in (SDF, RAYCAST) if is_free(spec, alternative)} == free
    assert written_of(spec, (SDF, RAYCAST)) == sorted(written)


def test_an_alternative_with_other_readings_is_never_chosen_but_may_be_written():
    other = Alternative("rays", {"query": "raycast"}, is_other=True)
    assert not is_free(Query(), other)
    assert is_free(Query(query="raycast"), other) and is_taken(Query(query="raycast"), other)

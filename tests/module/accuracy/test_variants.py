"""Which variants of a sensor are what a document says, and which `accuracy` may choose."""

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


def of(**queries: Query):
    return variants_of(
        DEPTH,
        "skin",
        DEPTH.spec.model_validate({"kind": "contact_depth", "links": "pad", "feels": ["cup"]}),
        queries,
        (SDF, RAYCAST),
    )


def test_a_way_is_the_documents_where_all_objects_have_it():
    """With a bowl by rays and a cup by a grid the document says neither."""
    assert [way.is_own for way in of(cup=Query(), bowl=Query()).queries] == [True, False]
    assert [way.is_own for way in of(cup=Query(), bowl=Query(query="raycast")).queries] == [False, False]
    assert of(cup=Query()).queries[1].changes == {"objects.cup.query": "raycast"}
    assert of(cup=Query(), bowl=Query()).queries[1].changes == {"objects.cup.query": "raycast", "objects.bowl.query": "raycast"}


def test_the_document_is_named_by_its_own_ways():
    assert of(cup=Query()).own.label == "sdf"
    assert of(cup=Query(), bowl=Query(query="raycast")).own.label == "as written"
    assert of(cup=Query()).own.is_own


@pytest.mark.parametrize(
    ("written", "free"),
    [
        ({}, {"sdf", "raycast"}),
        ({"query": "sdf"}, {"sdf"}),
        ({"query": "raycast"}, {"raycast"}),
        ({"spacing": 0.001}, {"sdf"}),  # which rays have no use for
        ({"query": "raycast", "spacing": 0.001}, set()),
    ],
)
def test_what_is_written_is_not_changed(written, free):
    spec = Query.model_validate(written)
    assert {own.label for own in (SDF, RAYCAST) if is_free(spec, own)} == free
    assert written_of(spec, (SDF, RAYCAST)) == sorted(written)


def test_what_reads_otherwise_is_never_chosen_but_may_be_written():
    other = Alternative("rays", {"query": "raycast"}, is_other=True)
    assert not is_free(Query(), other)
    assert is_free(Query(query="raycast"), other) and is_taken(Query(query="raycast"), other)

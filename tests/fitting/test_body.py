"""A template's mesh, bound to its midline, with the neighbours of its faces."""

import pytest

from stream_dmr.fitting.body import Body
from stream_dmr.template.template_file import bundled_names, load_template


@pytest.mark.parametrize("name", bundled_names())
def test_each_edge_lies_between_the_face_along_it_and_the_one_against_it(name: str):
    body = Body.from_template(load_template(name))
    directed = [{(a, b), (b, c), (c, a)} for a, b, c in body.faces.tolist()]
    for (a, b), (along, against) in zip(body.edges.tolist(), body.edge_faces.tolist(), strict=True):
        assert (a, b) in directed[along]
        assert (b, a) in directed[against]
    assert len(set(map(tuple, body.edges.tolist()))) == len(body.edges) == 3 * len(body.faces) // 2

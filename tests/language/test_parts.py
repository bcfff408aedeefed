import numpy as np
import pytest
import trimesh

from mjx_grasp.language.grounding import GroundingError, target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.parametric import stand_in

GROUNDER = PartGrounder()
CATALOGUE = load_catalogue()


def catalogue_target(name):
    return target_of(
        name,
        stand_in(CATALOGUE[name].scan_of, CATALOGUE[name].scale),
        CATALOGUE[name].parts_on(scan=False),
    )


def box(shift=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.box(extents=(0.1, 0.04, 0.2))
    mesh.apply_translation(shift)
    return target_of("a box", mesh)


@pytest.mark.parametrize(
    ("instruction", "name", "part"),
    [
        ("by the handle", "mug", "handle"),
        ("Pick it up at the GRIP, please.", "mug", "handle"),
        ("lid", "mustard_bottle", "cap"),
        ("hold the stalk", "banana", "stem"),
        ("the base", "wine_glass", "foot"),
        ("brim of the bowl", "bowl", "rim"),
        ("handle", "pitcher_base_scaled", "handle"),
    ],
)
def test_parts_and_their_synonyms(instruction, name, part):
    anchor = GROUNDER.ground(instruction, catalogue_target(name))
    known = CATALOGUE[name].parts[part]
    assert np.allclose(anchor.point, known.at, atol=1e-9)
    assert np.array_equal(anchor.size, known.size)
    assert anchor.source == f"part: {part}"


@pytest.mark.parametrize(
    ("instruction", "point"),
    [
        ("top", (0, 0, 0.1)),
        ("grasp the underside", (0, 0, -0.1)),
        ("the base", (0, 0, -0.1)),
        ("on the left side", (-0.05, 0, 0)),
        ("right", (0.05, 0, 0)),
        ("from the front", (0, -0.02, 0)),
        ("rear", (0, 0.02, 0)),
        ("around the body", (0, 0, 0)),
    ],
)
@pytest.mark.parametrize("shift", [(0, 0, 0), (1.0, -2.0, 0.3)])
def test_sides_of_any_mesh_in_its_own_frame(instruction, point, shift):
    anchor = GROUNDER.ground(instruction, box(shift))
    assert np.allclose(anchor.point, np.add(point, shift))
    assert anchor.source.startswith("side: ") and not anchor.size.any()


def test_parts_follow_a_scan_whose_origin_is_elsewhere():
    mesh = stand_in("mug")
    mesh.apply_translation([0.3, 0.1, -0.2])
    target = target_of("mug", mesh, CATALOGUE["mug"].parts)
    expected = np.add(CATALOGUE["mug"].parts["handle"].at, [0.3, 0.1, -0.2])
    assert np.allclose(GROUNDER.ground("handle", target).point, expected, atol=1e-9)


@pytest.mark.parametrize("name", [n for n, info in CATALOGUE.items() if info.parts])
def test_every_part_of_the_catalogue_is_found_by_its_name_and_is_on_the_object(name):
    target = catalogue_target(name)
    low, high = target.vertices.min(axis=0), target.vertices.max(axis=0)
    for part, (at, size) in target.parts.items():
        anchor = GROUNDER.ground(f"by the {part}", target)
        found = anchor.point
        assert np.allclose(found, at) and np.allclose(anchor.size, size)
        assert np.all(found > low - 0.01) and np.all(found < high + 0.01)


@pytest.mark.parametrize(
    ("instruction", "found"),
    [
        ("by the trunk", "no known part"),
        ("by the handle", "no known part"),
        ("", "no known part"),
        ("the top left", "top and left"),
        ("not at the top", "negation"),
        ("anywhere but the top", "negation"),
        ("you can't hold the top", "negation"),
        ("shouldn’t touch the top", "negation"),
        ("away from the top", "negation"),
        ("don't touch the top", "negation"),
    ],
)
def test_what_is_not_understood_says_what_would_be(instruction, found):
    with pytest.raises(GroundingError, match=found) as error:
        GROUNDER.ground(instruction, box())
    assert "top, bottom, left, right, front, back, middle" in str(error.value)


def test_the_error_lists_the_parts_of_this_object():
    with pytest.raises(GroundingError, match="handle, rim, top, bottom"):
        GROUNDER.ground("by the wheel", catalogue_target("mug"))
    with pytest.raises(GroundingError, match="handle and rim"):
        GROUNDER.ground("between handle and rim", catalogue_target("mug"))

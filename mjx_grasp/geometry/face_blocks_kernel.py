"""The search for nearest faces in :mod:`.face_blocks`, for CPUs."""

# Types in a kernel are Warp's own.
# mypy: ignore-errors

from pathlib import Path

import warp as wp

wp.set_module_options({"enable_backward": False})

_SEARCH = Path(__file__).with_name("face_blocks_search.cpp").read_text()


@wp.func_native(_SEARCH)
def search(
    point: wp.vec3,
    slot: int,
    root: int,
    first_block: int,
    boxes: wp.array(dtype=float),
    first: wp.array(dtype=int),
    blocks: wp.array(dtype=float),
) -> int:
    """The slot of the nearest face; the search starts at ``slot``, if that is not negative."""
    ...


@wp.kernel
def nearest(
    root: wp.array(dtype=int),
    first_block: wp.array(dtype=int),
    boxes: wp.array(dtype=float),
    first: wp.array(dtype=int),
    blocks: wp.array(dtype=float),
    face_of_slot: wp.array(dtype=int),
    slot_of_face: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    near: wp.array(dtype=int),
    sides: int,
    padded: int,
    length: int,
    face: wp.array(dtype=int),
):
    """The face nearest to each point of a chain; the search for one starts at that of the last."""
    side, i = wp.tid()
    o = owner[i]
    slot = int(-1)
    if near[i] >= 0:
        slot = slot_of_face[near[i]]
    for k in range(length):
        at = (k * sides + side) * padded + i
        slot = search(points[at], slot, root[o], first_block[o], boxes, first, blocks)
        face[at] = face_of_slot[slot]

"""From a mesh of your own to three points that a hand can go for.

    python examples/own_mesh.py [MESH]

MESH is a file of a closed mesh in metres; without one it is a bottle made here. It stands on the
table, in front of a hand. The heatmap is computed once; then anchor, scores, candidates, selection
and targets are one compiled call. Points are printed in the object frame: of MESH from the middle
of its bounding box, of the bottle from its foot.
"""

import sys
import time
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import mjx_grasp


def bottle() -> trimesh.Trimesh:
    """A bottle 20 cm high, standing on z = 0."""
    outline = [[0, 0], [0.03, 0], [0.03, 0.12], [0.012, 0.15], [0.012, 0.2], [0, 0.2]]
    rings = np.concatenate([np.linspace(a, b, 12, endpoint=False) for a, b in pairwise(outline)])
    return trimesh.creation.revolve(np.vstack([rings, outline[-1]]), sections=48)


def main(arguments: list[str]) -> None:
    """Prints where thumb, index and middle finger should touch."""
    robot = mjx_grasp.load_robot()
    if arguments:  # checked, and coarse surfaces are refined
        obj = mjx_grasp.load_object(arguments[0])
        mesh, heatmap = obj.mesh, mjx_grasp.heatmap_of(obj, robot.hand)
    else:
        mesh = bottle()
        heatmap = mjx_grasp.compute_heatmap(
            mesh.vertices,
            mesh.faces,
            None,
            span=robot.hand.span,
            scoring_friction=robot.hand.scoring_friction,
        )
    print(f"{int(heatmap.valid.sum())} of {len(heatmap.vertices)} vertices have a candidate")

    # The hand as it is: tips in front of the object, the palm looking along +x.
    hand = mjx_grasp.HandPose(
        tips=jnp.array([[0.4, 0.05, 0.2], [0.4, -0.04, 0.22], [0.4, -0.04, 0.18]]),
        approach=jnp.array([1.0, 0.0, 0.0]),
        opposing=jnp.array([0.0, 1.0, 0.0]),
    )
    # The object's pose: its lowest point is on the table, which is z = 0.
    where, turned = jnp.array([0.5, 0.0, -mesh.bounds[0][2]]), jnp.eye(3)
    settings = mjx_grasp.SelectionConfig()

    @jax.jit
    def choose(anchor):
        score = mjx_grasp.steer_contacts(heatmap, anchor)
        candidates = mjx_grasp.from_heatmap(heatmap, score, count=256)
        state = mjx_grasp.start_selection(candidates, hand, turned)
        return mjx_grasp.select(candidates, state, hand, where, turned, settings)[0]

    low, high = mesh.bounds
    for part, height in (("low", 0.25), ("high", 0.75)):
        anchor = jnp.asarray([*mesh.centroid[:2], low[2] + height * (high - low)[2]])
        jax.block_until_ready(choose(anchor))  # compiles
        start = time.perf_counter()
        targets = jax.block_until_ready(choose(anchor))
        took = 1e3 * (time.perf_counter() - start)
        if not targets.valid:
            least = 1e3 * settings.targets.min_height
            print(
                f"{part}: nothing there that the hand can span, with every finger at least "
                f"{least:g} mm above the table"
            )
            continue
        print(f"{part}, in {took:.1f} ms:")
        for finger, point in zip(robot.hand.fingers, targets.position - where, strict=True):
            print(f"  {finger.name:6} at {np.round(1e3 * np.asarray(point), 1)} mm on the object")


if __name__ == "__main__":
    main(sys.argv[1:])

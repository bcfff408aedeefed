"""Reaching with a robot that the package does not ship: six arm axes and three fingers of boxes.

    python examples/another_robot.py [DESCRIPTION.yaml]

All that the package needs of a robot is an MJCF and a description like robot/six_axis.yaml;
`python -m mjx_grasp.robot.spec FILE` checks one.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

import mjx_grasp
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import cylinder_candidates
from mjx_grasp.reaching.state import ReachOutcome

TICKS = 600  # 6 s at 100 Hz


def main(description: Path, library_size: int = 60_000) -> ReachOutcome:
    """Reaches for a cylinder that stands on the table."""
    settings = mjx_grasp.reach_preset("default")
    body = mjx_grasp.robot_body(mjx_grasp.load_robot(description))
    reacher = mjx_grasp.Reacher(body, settings.reach, settings.selection)
    plan = replace(settings.plan, library=library_size)
    planner, library = mjx_grasp.Planner(reacher, plan), mjx_grasp.start_library(body, plan)

    cylinder = Cylinder(jnp.float32(0.03), jnp.float32(0.06))  # radius and half length
    candidates = cylinder_candidates(*cylinder, body.robot.hand.span)
    p, R, home = jnp.array([0.5, -0.1, 0.06]), jnp.eye(3), jnp.asarray(body.home)

    @jax.jit
    def reach(key):
        around = mjx_grasp.Surroundings.still(cylinder, p, R)
        plans = planner.search(library, candidates, around, home, key).plans

        def tick(carry, _):
            state, q = carry
            state, done = reacher.tick(
                state, q, cylinder, candidates, p, R, jnp.zeros((0, 4)), plans
            )
            return (state, q + 0.01 * done.velocity), done.report.error

        start = reacher.start(home, candidates, p, R, plans), home
        (state, _), errors = jax.lax.scan(tick, start, length=TICKS)
        return state, errors

    state, errors = reach(jax.random.key(0))
    outcome = ReachOutcome(int(state.outcome))
    print(f"{body.robot.name}: {outcome.name.lower()} after {float(state.clock):.1f} s")
    thumb, first, second = 1e3 * errors[-1]
    print(f"tips are {thumb:.1f}, {first:.1f} and {second:.1f} mm from their targets")
    return outcome


if __name__ == "__main__":
    shipped = Path(__file__).parent / "robot" / "six_axis.yaml"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else shipped)

"""How hard a whole grasp presses, by what the object's weight asks of the contacts of its plan.

Nothing of the weight is felt before the lift. A grip that answers to load would be late: a heavy
object slips first, and one that hangs on a thin wall turns.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.closing.closer import CloserState
from mjx_grasp.closing.config import GripConfig
from mjx_grasp.closing.forces import finger_shares
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.levered import across_thin_wall
from mjx_grasp.grasp.targets import three_normals, three_points
from mjx_grasp.grasp.wrench_margin import ContactConfig, Load, holding_force
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.state import Known, Seen
from mjx_grasp.posture.body import FINGERS
from mjx_grasp.reaching.state import Plans


def force_of_plan(
    known: Known,
    seen: Seen,
    plan: Plans,
    targets: TargetConfig,
    grip: GripConfig,
    config: GrasperConfig,
) -> Float[Array, ""]:
    """F that holds the known weight by a plan's contacts at the grip's own friction μ₀ [N].

    The wrench margin's force is that of the thumb, which presses with 3/2 F where it bears what the
    wraps bear together.

    Args:
        known: The object.
        seen: Where it is.
        plan: One of them.
        targets: Where the three points of a candidate are.
        grip: The closer's; without a friction its own force is kept.
        config: Bounds.
    """
    if grip.friction is None:
        return jnp.float32(grip.force)
    of = jax.tree.map(lambda leaf: leaf[plan.candidate], known.candidates)
    centre = known.candidates.centre[plan.candidate]
    position = three_points(of.thumb, centre, plan.spread, targets)
    load = Load(known.weight * -seen.R_wo[2], known.com)
    contact = ContactConfig(friction=grip.friction)
    thumb = holding_force(position, -three_normals(of.normal, of.wrap_normal), load, contact)
    share = finger_shares(FINGERS, grip)[0]
    most = jnp.clip(config.hardest * known.weight / share, grip.force, grip.most)
    return jnp.clip(thumb / share, grip.force, most)


def budget_for(weight: Float[Array, ""], budget: float, config: GrasperConfig) -> Float[Array, ""]:
    """Mean force per finger that a policy may take for an object [N].

    min(B, max(least, k·W)); B where the weight is not known.

    Args:
        weight: W, 0 where it is not known [N].
        budget: B, for any object [N].
        config: k and the least.
    """
    enough = jnp.maximum(config.least_budget, config.budget_per_weight * weight)
    bounded = (weight > 0) & (config.budget_per_weight > 0)
    return jnp.where(bounded, jnp.minimum(budget, enough), budget)


def preloaded(
    closer: CloserState,
    contacts: Float[Array, "f 3"],
    force: Float[Array, ""],
    grip: GripConfig,
    config: GrasperConfig,
) -> CloserState:
    """Presses with no less than the plan says, where the grip answers to load.

    A thin wall is gripped harder than that, but not before all is ready for the lift: it would be
    pushed away.

    Args:
        closer: As it has sensed.
        contacts: The thumb's first [m].
        force: Of the plan that is followed [N].
        grip: The closer's.
        config: How much harder.
    """
    if grip.friction is None:
        return closer
    hangs = closer.lifting & across_thin_wall(contacts)
    harder = jnp.minimum(config.across_walls * force, grip.most)
    least = jnp.where(hangs, harder, 0.0)
    level = jnp.maximum(closer.level, jnp.maximum(force, least))
    return closer._replace(level=level, least=least)

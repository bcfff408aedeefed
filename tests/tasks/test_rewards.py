import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Truth
from mjx_grasp.tasks import rewards
from mjx_grasp.tasks.config import RewardConfig

CONFIG = RewardConfig()
seeds = st.integers(0, 2**31)


def size(twist):
    return np.sqrt((twist[:3] ** 2).sum() + 0.05**2 * (twist[3:] ** 2).sum())


def expected_reach(twist, guidance):
    return np.mean(
        [
            np.exp(-size(v - g) / (0.5 * (size(g) + 0.02)))
            for v, g in zip(twist, guidance, strict=True)
        ]
    )


def state(seed):
    rng = np.random.default_rng(seed)
    return dict(
        twist=rng.normal(size=(3, 6)) * 0.05,
        guidance=rng.normal(size=(3, 6)) * 0.05,
        touching=rng.random(3) < 0.5,
        palm=rng.normal(size=3) * 0.1,
        speed=rng.uniform(0, 0.15),
        actions=rng.uniform(-1, 1, size=(3, 15)),
    )


def moment(lifting=False, in_time=True, **changes):
    """A moment of one world in which all is zero but what is given."""
    rest = dict(
        guidance=np.zeros((3, 6)),
        pad_twist=np.zeros((3, 6)),
        palm_velocity=np.zeros(3),
        lift_speed=0.0,
        slip=0.0,
        nearer=0.0,
        homing=0.0,
        lift_force=0.0,
        budget=3.0,
        **{name: np.zeros(15) for name in ("action", "last_action", "before_last")},
    )
    touching = changes.pop("touching", np.zeros(3, bool))
    values = {name: jnp.asarray(x, jnp.float32) for name, x in (rest | changes).items()}
    return rewards.Moment(
        measured=Measured(*[jnp.zeros(0)] * len(Measured._fields)),
        truth=Truth(*[jnp.zeros(0)] * len(Truth._fields))._replace(tip_found=jnp.asarray(touching)),
        lifting=jnp.asarray(lifting),
        in_time=jnp.asarray(in_time),
        **values,
    )


def total(lifting, s):
    now = moment(
        lifting,
        pad_twist=s["twist"],
        guidance=s["guidance"],
        touching=s["touching"],
        palm_velocity=s["palm"],
        lift_speed=s["speed"],
        **dict(zip(("action", "last_action", "before_last"), s["actions"], strict=True)),
    )
    return sum(term.weight * term.value(now) for term in rewards.closing_terms(CONFIG))


@given(seed=seeds)
def test_total_agrees_with_the_published_weights(seed):
    s = state(seed)
    now, last, before = s["actions"]
    smooth = -0.01 * ((now - last) ** 2).sum() - 0.005 * ((now - 2 * last + before) ** 2).sum()
    contact = 1.0 * s["touching"].sum()
    lift = np.exp(-(((s["palm"][2] - s["speed"]) / 0.1) ** 2)) * np.exp(
        -((np.hypot(*s["palm"][:2]) / 0.1) ** 2)
    )
    acquiring = 3.0 * expected_reach(s["twist"], s["guidance"]) + contact + smooth
    lifting = 2.0 * lift + contact + smooth
    np.testing.assert_allclose(total(False, s), acquiring, rtol=2e-4, atol=1e-4)
    np.testing.assert_allclose(total(True, s), lifting, rtol=2e-4, atol=1e-4)


def test_reach_is_one_on_the_field_and_known_beside_it():
    g = jnp.array([[0.08, 0, 0, 0, 0, 0]] * 3)
    at = lambda twist: float(rewards.reach(moment(guidance=g, pad_twist=twist), CONFIG))  # noqa: E731
    assert np.isclose(at(g), 1.0, atol=1e-4)
    # Standing still: error 0.08 against a scale of 0.5·(0.08 + 0.02).
    assert np.isclose(at(0 * g), np.exp(-0.08 / 0.05), rtol=1e-4)
    # One finger of three off.
    assert np.isclose(at(g.at[0].set(0.0)), (2 + np.exp(-1.6)) / 3, rtol=1e-4)


@given(seed=seeds)
def test_reach_stays_within_its_bounds(seed):
    s = state(seed)
    now = moment(pad_twist=s["twist"], guidance=s["guidance"])
    assert 0.0 <= float(rewards.reach(now, CONFIG)) <= 1.0


def test_lift_peaks_at_the_scripted_speed_and_falls_sideways():
    def at(v, speed):
        return float(rewards.lift(moment(palm_velocity=v, lift_speed=speed), CONFIG))

    assert np.isclose(at([0, 0, 0.15], 0.15), 1.0)
    assert np.isclose(at([0, 0, 0.05], 0.15), np.exp(-1), rtol=1e-4)
    assert np.isclose(at([0.06, 0.08, 0.15], 0.15), np.exp(-1), rtol=1e-4)
    # After the script's end the palm is paid for standing still, not for rising on.
    assert at([0, 0, 0.0], 0.0) > at([0, 0, 0.15], 0.0)


def test_as_published_the_lift_asks_for_one_speed_for_ever():
    config = RewardConfig(lift_speed=0.15)
    for script in (0.0, 0.15):
        rising = moment(palm_velocity=[0, 0, 0.15], lift_speed=script)
        assert np.isclose(rewards.lift(rising, config), 1.0)


@given(seed=seeds)
def test_constant_and_ramped_actions_cost_what_they_should(seed):
    a = jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, 15), jnp.float32)
    terms = {t.name: t for t in rewards.closing_terms(CONFIG)}

    def paid(name, action, last, before=a):
        now = moment(action=action, last_action=last, before_last=before)
        return float(terms[name].weight * terms[name].value(now))

    assert paid("action_rate", a, a) == 0
    assert paid("action_acceleration", a, a, a) == 0
    # A constant slope has no second difference.
    assert np.isclose(paid("action_acceleration", 3 * a, 2 * a, a), 0, atol=1e-6)
    assert paid("action_rate", 2 * a, a) <= 0


@given(seed=seeds, angle=st.floats(-3, 3))
def test_turning_the_world_about_the_vertical_changes_nothing(seed, angle):
    s = state(seed)
    c, q = np.cos(angle), np.sin(angle)
    T = np.array([[c, -q, 0], [q, c, 0], [0, 0, 1.0]])
    turned = s | {
        "twist": (s["twist"].reshape(3, 2, 3) @ T.T).reshape(3, 6),
        "guidance": (s["guidance"].reshape(3, 2, 3) @ T.T).reshape(3, 6),
        "palm": T @ s["palm"],
    }
    for lifting in (False, True):
        np.testing.assert_allclose(total(lifting, turned), total(lifting, s), atol=5e-5)


def test_contact_counts_fingers_in_batches():
    touching = jnp.array([[True, False, True], [False] * 3, [True] * 3])
    np.testing.assert_array_equal(rewards.contact(moment(touching=touching)), [2, 0, 3])


def test_neither_haste_nor_refusal_to_lift_pays():
    """As much is paid before the lift as in it, but not for ever."""
    (held,) = [t for t in rewards.closing_terms(RewardConfig(held=4.0)) if t.name == "held"]
    assert held.weight == 4.0
    assert held.value(moment(lifting=False)) == held.value(moment(lifting=True)) == 1.0
    assert held.value(moment(lifting=False, in_time=False)) == 0.0
    assert held.value(moment(lifting=True, in_time=False)) == 1.0
    slipped = held.value(moment(lifting=True, slip=CONFIG.held_scale))
    np.testing.assert_allclose(slipped, np.exp(-1.0), rtol=1e-6)


def test_a_hard_finger_costs_beyond_a_force_up_to_a_bound():
    """In the lift or before."""
    config = RewardConfig(hard_from=6.0)

    def cost(force, lifting=False):
        at = moment(lifting=lifting)
        fingers = jnp.zeros((3, 3)).at[1, 2].set(force)
        return float(
            rewards.hard(at._replace(truth=at.truth._replace(finger_force=fingers)), config)
        )

    assert cost(5.9) == 0.0
    np.testing.assert_allclose([cost(8.0), cost(-8.0, True), cost(500.0)], [2, 2, 10], rtol=1e-5)


def test_what_is_spent_is_a_share_of_the_budget_and_paid_in_the_lift_alone():
    (spent,) = [t for t in rewards.closing_terms(RewardConfig(spent=-2.0)) if t.name == "spent"]

    def share(force, lifting=True, budget=4.0):
        at = moment(lifting=lifting, budget=budget)
        fingers = jnp.zeros((3, 3)).at[:, 1].set(force)
        return float(spent.value(at._replace(truth=at.truth._replace(finger_force=fingers))))

    assert spent.weight == -2.0 and share(3.0, lifting=False) == 0.0
    np.testing.assert_allclose([share(1.0), share(3.0), share(300.0)], [0.25, 0.75, 1.0], rtol=1e-5)
    np.testing.assert_allclose(share(1.0, budget=8.0), 0.125, rtol=1e-5)

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import made_up
from scipy.stats import chi2

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.sampling import best_triple, sample_triples, triple_distance

KEY = jax.random.key(3)


def random_heatmap(seed, n=40):
    rng = np.random.default_rng(seed)
    return made_up(rng.uniform(0, 1, n), valid=rng.uniform(size=n) > 0.3, seed=seed)


def pairwise(triples):
    centre = triples.wrap.mean(axis=1)
    return np.asarray(
        triple_distance(triples.thumb[:, None], centre[:, None], triples.thumb, centre)
    )


@pytest.mark.parametrize("seed", range(5))
def test_temperature_zero_is_the_argmax_whatever_the_key(seed):
    heatmap = random_heatmap(seed)
    best = int(np.argmax(np.where(heatmap.valid, heatmap.score, -1)))
    drawn = sample_triples(jax.random.key(seed), heatmap, 1, temperature=0.0)
    assert int(drawn.candidate[0]) == int(best_triple(heatmap).candidate[0]) == best
    close = sample_triples(jax.random.key(seed), heatmap, 1, temperature=1e-6)
    assert int(close.candidate[0]) == best


def test_at_temperature_zero_the_rest_follow_by_score():
    heatmap = random_heatmap(1)
    order = np.argsort(-np.where(heatmap.valid, heatmap.score, -1))[:6]
    drawn = sample_triples(KEY, heatmap, 6, temperature=0.0, min_distance=0.0)
    assert drawn.candidate.tolist() == order.tolist()


@settings(max_examples=25)
@given(st.integers(0, 1000), st.sampled_from([0.0, 0.05, 1.0]), st.sampled_from([None, 3, 12]))
def test_never_an_invalid_candidate_a_bad_one_or_one_beyond_the_top(seed, temperature, top_k):
    heatmap = random_heatmap(seed)
    drawn = sample_triples(
        jax.random.key(seed), heatmap, 8, temperature=temperature, top_k=top_k,
        min_distance=0.0, min_score=0.3,
    )  # fmt: skip
    index = np.asarray(drawn.candidate)[np.asarray(drawn.valid)]
    allowed = np.flatnonzero(heatmap.valid & (heatmap.score >= 0.3))
    if top_k is not None:
        allowed = allowed[np.argsort(-heatmap.score[allowed])][:top_k]
    assert set(index) <= set(allowed)
    assert len(set(index)) == len(index) == min(8, len(allowed))


@pytest.mark.parametrize("temperature", [0.0, 0.1, 2.0])
def test_triples_keep_their_distance(temperature):
    heatmap = random_heatmap(7, n=300)
    drawn = sample_triples(KEY, heatmap, 10, temperature=temperature, min_distance=0.03)
    assert drawn.valid.all()
    gap = pairwise(drawn)
    assert gap[~np.eye(10, dtype=bool)].min() >= 0.03


def test_suppression_leaves_nothing_out_that_is_far_enough():
    # Greedy: whatever is not drawn is too close to a triple that was drawn.
    heatmap = random_heatmap(8, n=60)
    drawn = sample_triples(KEY, heatmap, 60, temperature=0.0, min_distance=0.04)
    kept = np.asarray(drawn.candidate)[np.asarray(drawn.valid)]
    assert 1 < len(kept) < 60
    rest = np.setdiff1d(np.flatnonzero(heatmap.valid & (heatmap.score >= 0.05)), kept)
    gap = triple_distance(
        *(jnp.asarray(x[rest, None]) for x in (heatmap.thumb, heatmap.centre)),
        *(jnp.asarray(x[kept]) for x in (heatmap.thumb, heatmap.centre)),
    )
    assert np.asarray(gap).min(axis=1).max() < 0.04


def test_the_same_thumb_with_another_opposite_is_another_triple():
    heatmap = made_up([0.9, 0.8, 0.7], thumb=np.zeros((3, 3)))
    far = heatmap.centre + np.float32([[0, 0, 0], [0.05, 0, 0], [0.001, 0, 0]])
    drawn = sample_triples(KEY, heatmap._replace(centre=far), 3, temperature=0.0)
    assert drawn.candidate.tolist()[:2] == [0, 1]
    assert drawn.valid.tolist() == [True, True, False]


def test_when_nothing_is_left_it_says_so_and_stays_finite():
    heatmap = made_up([0.9, 0.8, 0.0], valid=[True, False, True])
    drawn = sample_triples(KEY, heatmap, 3, temperature=0.5)
    assert drawn.valid.tolist() == [True, False, False]
    assert drawn.score.tolist() == [pytest.approx(0.9), 0.0, 0.0]
    assert all(np.isfinite(np.asarray(leaf, float)).all() for leaf in drawn)
    nothing = best_triple(made_up([0.0, 0.0]))
    assert not nothing.valid.any()


def test_deterministic_by_key_and_not_constant():
    heatmap = random_heatmap(2, n=200)
    draw = [
        sample_triples(jax.random.key(k), heatmap, 5, temperature=1.0).candidate.tolist()
        for k in (0, 0, 1)
    ]
    assert draw[0] == draw[1] != draw[2]


@pytest.mark.parametrize("temperature", [0.1, 0.5])
def test_the_first_draw_follows_the_softmax(temperature):
    score = np.array([0.9, 0.8, 0.75, 0.5, 0.3, 0.2])
    valid = np.array([True, True, True, False, True, True])
    heatmap = made_up(score, valid=valid)
    n = 20_000
    drawn = many(heatmap, n, temperature)[:, 0]
    weight = np.where(valid, np.exp(score / temperature), 0.0)
    assert_distributed(drawn, weight / weight.sum(), n)


def test_the_second_draw_follows_the_softmax_of_what_the_first_left():
    # 0 and 1 suppress each other: after 0 only 2 and 3 are left.
    thumb = np.array([[0, 0, 0], [0.01, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    score, temperature, n = np.array([0.6, 0.5, 0.4, 0.3]), 0.2, 20_000
    drawn = many(made_up(score, thumb), n, temperature)
    after = drawn[drawn[:, 0] == 0, 1]
    weight = np.exp(score / temperature) * [0, 0, 1, 1]
    assert_distributed(after, weight / weight.sum(), len(after))


def many(heatmap, n, temperature):
    keys = jax.random.split(jax.random.key(11), n)
    draw = jax.vmap(lambda k: sample_triples(k, heatmap, 2, temperature=temperature).candidate)
    return np.asarray(jax.jit(draw)(keys))


def assert_distributed(drawn, expected, n):
    counts = np.bincount(drawn, minlength=len(expected))
    assert counts[expected == 0].sum() == 0
    possible = expected > 0
    statistic = np.sum((counts - n * expected)[possible] ** 2 / (n * expected[possible]))
    # With fixed keys this either holds or not; 1e-4 leaves room for other versions' generators.
    assert statistic < chi2.isf(1e-4, possible.sum() - 1)


def test_jit_and_vmap_agree_with_eager():
    heatmap = random_heatmap(4, n=120)
    keys = jax.random.split(KEY, 4)

    def draw(key, score):
        return sample_triples(key, heatmap, 4, score, temperature=0.3, top_k=50)

    scores = np.stack([heatmap.score * k for k in (1.0, 0.9, 0.8, 0.7)]).astype(np.float32)
    batched = jax.jit(jax.vmap(draw))(keys, scores)
    with jax.disable_jit():
        for i in range(4):
            one = draw(keys[i], scores[i])
            jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b), batched, one)


def test_the_geometry_is_that_of_the_candidate():
    heatmap = random_heatmap(5)
    drawn = sample_triples(KEY, heatmap, 3)
    index = np.asarray(drawn.candidate)
    for name in ("thumb", "wrap", "wrap_normals", "axis", "width", "score"):
        assert np.array_equal(getattr(drawn, name), getattr(heatmap, name)[index])
    assert np.array_equal(drawn.thumb_normal, heatmap.normals[index])


def test_other_scores_draw_other_triples():
    heatmap = random_heatmap(6)
    wanted = int(np.flatnonzero(heatmap.valid)[3])
    score = np.zeros_like(heatmap.score)
    score[wanted] = 0.2
    assert best_triple(heatmap, score).candidate.tolist() == [wanted]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [({"count": 0}, "count"), ({"top_k": 0}, "top_k"), ({"temperature": -0.1}, "temperature")],
)
def test_bad_settings_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as error:
        sample_triples(KEY, random_heatmap(0), **({"count": 1} | arguments))
    assert error.value.field == field

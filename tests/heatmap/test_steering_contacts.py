"""Steering by the contacts themselves: its laws, and that it finds the parts of the catalogue."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import made_up
from scipy.spatial.transform import Rotation

from mjx_grasp.heatmap.compute import compute_heatmaps, heatmap_surface
from mjx_grasp.heatmap.sampling import best_triple
from mjx_grasp.heatmap.steering import (
    SIGMA_M,
    contact_sigma,
    steer,
    steer_contacts,
    steer_near,
    steer_to,
)
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import object_mesh

HEATMAP = made_up(np.random.default_rng(1).uniform(0.01, 1.0, 80), seed=1)
PART = np.float32([0.02, 0.01, 0.04])


def anchors(count, seed=0):
    return np.random.default_rng(seed).uniform(-0.06, 0.06, (count, 3)).astype(np.float32)


def by_hand(heatmap, anchor, size, sigma):
    """The formula in double precision, contact by contact."""
    quality = np.asarray(heatmap.score_without_com, np.float64)
    apart = np.zeros(len(quality))
    for contact in (heatmap.thumb, heatmap.wrap[:, 0], heatmap.wrap[:, 1]):
        nearest = np.clip(contact, anchor - size / 2, anchor + size / 2)
        apart += np.linalg.norm(contact - nearest, axis=1) ** 2
    best = np.argmax(np.log(quality) - apart / sigma**2)
    return quality * np.exp((apart[best] - apart) / sigma**2), best


@pytest.mark.parametrize("size", [np.zeros(3), PART])
@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_it_is_its_formula(size, sigma):
    for anchor in anchors(5):
        score = np.asarray(steer_contacts(HEATMAP, anchor, size, sigma))
        expected, best = by_hand(HEATMAP, anchor, size, sigma)
        assert np.allclose(score, expected, rtol=1e-3, atol=1e-6)
        assert score.argmax() == best
        assert score[best] == pytest.approx(HEATMAP.score_without_com[best], rel=1e-6)


def moved(heatmap, R, shift, k=1.0):
    points = {n: k * getattr(heatmap, n) @ R.T + shift for n in ("thumb", "wrap", "centre")}
    points |= {"axis": heatmap.axis @ R.T, "width": k * heatmap.width}
    return heatmap._replace(**jax.tree.map(np.float32, points))


@pytest.mark.parametrize("seed", range(4))
def test_a_rigid_motion_of_everything_changes_nothing(seed):
    R, shift = Rotation.random(random_state=seed).as_matrix(), anchors(1, seed)[0]
    anchor = anchors(1, 9)[0]
    still = steer_contacts(HEATMAP, anchor)
    there = steer_contacts(moved(HEATMAP, R, shift), np.float32(R @ anchor + shift))
    assert np.allclose(still, there, rtol=1e-4, atol=1e-6)
    # A part's box turns with the object's axes: by right angles.
    R = np.roll(np.eye(3), seed, axis=0) * [-1.0, 1.0, -1.0]
    still = steer_contacts(HEATMAP, anchor, PART)
    turned = np.float32(np.abs(R @ PART))
    there = steer_contacts(moved(HEATMAP, R, shift), np.float32(R @ anchor + shift), turned)
    assert np.allclose(still, there, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("k", [0.5, 3.0])
def test_all_lengths_may_be_scaled_together(k):
    large, anchor = moved(HEATMAP, np.eye(3), 0.0, k), anchors(1)[0]
    still = steer_contacts(HEATMAP, anchor, PART, 0.01)
    assert np.allclose(steer_contacts(large, k * anchor, k * PART, k * 0.01), still, rtol=1e-4)


def test_many_anchors_are_a_vmap_and_compiling_changes_nothing():
    many = anchors(6)
    sizes = np.abs(anchors(6, 3))
    rows = jax.vmap(lambda a, s: steer_contacts(HEATMAP, a, s))(many, sizes)
    for row, anchor, size in zip(rows, many, sizes, strict=True):
        one = steer_contacts(HEATMAP, anchor, size)
        assert np.allclose(row, one, rtol=1e-5, atol=1e-7)
        with jax.disable_jit():
            eager = steer_contacts(jax.tree.map(jnp.asarray, HEATMAP), anchor, size)
        assert np.allclose(eager, one, rtol=1e-5, atol=1e-7)


def test_on_the_part_quality_alone_decides():
    inside = np.abs(HEATMAP.thumb[:, :2]).max(axis=1) < 0.02
    size = np.float32([0.08, 0.04, 0.3])  # the wraps lie 15 mm beside the thumb, 60 mm below it
    score = np.asarray(steer_contacts(HEATMAP, np.zeros(3), size, 0.001))
    assert 3 < inside.sum() < 70
    assert np.allclose(score[inside], HEATMAP.score_without_com[inside], rtol=1e-6)
    assert score[~inside].max() < score[inside].max()


def test_far_away_and_on_thin_parts_scores_stay_usable():
    for anchor in (np.float32([5.0, 0.0, 0.0]), np.float32([0.0, 0.0, -0.4])):
        score = np.asarray(steer_contacts(HEATMAP, anchor, sigma=0.003))
        assert np.isfinite(score).all() and 0.0 < score.max() <= 1.0
        assert not np.any(steer(HEATMAP, anchor, 0.003) > 1e-20) or abs(anchor[0]) < 1


def test_of_two_equally_good_candidates_the_nearer_one_scores_more_however_far_both_are():
    alike = HEATMAP._replace(score_without_com=np.full(80, 0.5, np.float32))
    corner = np.float32([-0.06, -0.06, -0.06])
    contacts = alike.thumb, alike.wrap[:, 0], alike.wrap[:, 1]
    apart = sum(np.linalg.norm(c - corner, axis=1) ** 2 for c in contacts)
    score = np.asarray(steer_contacts(alike, corner, sigma=0.002))
    order = np.argsort(apart)
    assert np.all(np.exp((apart.min() - apart[order[-40:]]) / 0.002**2) < 1e-30)
    assert np.all(np.diff(score[order]) <= 0) and len(np.unique(score)) > 60 and score.min() > 0


def test_what_is_no_candidate_has_no_score():
    valid = np.arange(80) % 3 > 0
    heatmap = HEATMAP._replace(valid=valid)
    score = np.asarray(steer_contacts(heatmap, HEATMAP.thumb[0]))
    assert np.all(score[~valid] == 0.0) and score.max() > 0.0
    nothing = HEATMAP._replace(score_without_com=np.zeros(80, np.float32))
    assert np.array_equal(steer_contacts(nothing, np.zeros(3)), np.zeros(80))


def test_the_scale_follows_the_part():
    assert float(contact_sigma(np.zeros(3))) == pytest.approx(SIGMA_M)
    assert float(contact_sigma(np.array([0.1, 0.04, 0.06]))) == pytest.approx(0.005)
    assert float(contact_sigma(np.array([0.1, 0.004, 0.06]))) == pytest.approx(0.002)
    score = steer_contacts(HEATMAP, np.zeros(3), PART)
    assert np.allclose(score, steer_contacts(HEATMAP, np.zeros(3), PART, 0.002))


def test_every_way_goes_by_its_name():
    place, sigma = anchors(1)[0], 0.02
    for name, expected in (
        ("contacts", steer_contacts(HEATMAP, place, PART, sigma)),
        ("axis", steer(HEATMAP, place, sigma)),
        ("between", steer_near(HEATMAP, place, sigma)),
    ):
        assert np.array_equal(steer_to(HEATMAP, place, PART, sigma, name), expected)
    by_default = steer_to(HEATMAP, place, PART)
    assert np.array_equal(by_default, steer_contacts(HEATMAP, place, PART))
    assert np.array_equal(steer_to(HEATMAP, place, steering="axis"), steer(HEATMAP, place, SIGMA_M))


@pytest.fixture(scope="module")
def stand_ins():
    """Heatmaps of every object with parts, for a hand of 20 to 90 mm."""
    named = {n: info for n, info in load_catalogue().items() if info.parts}
    meshes = [heatmap_surface(object_mesh(n, None)) for n in named]
    arrays = [(np.asarray(m.vertices), np.asarray(m.faces)) for m in meshes]
    found = compute_heatmaps(arrays, None, (0.02, 0.09), 0.5)
    return {
        n: (info.parts_on(scan=False), jax.tree.map(np.asarray, heatmap))
        for (n, info), heatmap in zip(named.items(), found, strict=True)
    }


def test_named_parts_get_all_three_contacts(stand_ins):
    # Wherever a grasp of the part exists at all; stand-ins follow the parts within a centimetre.
    found = {}
    for name, (parts, heatmap) in stand_ins.items():
        contacts = np.concatenate([heatmap.thumb[:, None], heatmap.wrap], axis=1)
        for part, (at, size) in parts.items():
            outside = (np.abs(contacts - at) - np.divide(size, 2)).max(axis=(1, 2))
            if heatmap.score_without_com[outside < 0.0].max(initial=0.0) < 0.05:
                continue
            score = steer_to(heatmap, np.array(at), np.array(size))
            found[name, part] = float(outside[np.argmax(score)])
    assert len(found) >= 15
    assert max(found.values()) < 0.005, found
    assert np.mean(np.array([*found.values()]) < 0.001) >= 0.85, found


def test_the_stem_of_the_glass_is_held_by_its_stem(stand_ins):
    parts, heatmap = stand_ins["wine_glass"]
    at, size = (np.array(x) for x in parts["stem"])
    heights = {}
    for steering in ("contacts", "axis"):
        drawn = best_triple(heatmap, steer_to(heatmap, at, size, steering=steering))
        heights[steering] = np.concatenate([drawn.thumb, drawn.wrap[0]])[:, 2] - at[2]
    assert np.abs(heights["contacts"]).max() < size[2] / 2
    assert np.abs(heights["axis"]).max() > size[2] / 2, "as published it takes bowl and foot"

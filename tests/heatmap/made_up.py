"""Heatmaps of made-up candidates: what files and sampling are tested with."""

import numpy as np

from mjx_grasp.heatmap.files import TERMS
from mjx_grasp.heatmap.steering import Heatmap


def made_up(score, thumb=None, valid=None, seed=0):
    """Candidates with these scores; opposite contacts 60 mm below the thumb along z."""
    rng = np.random.default_rng(seed)
    score = np.asarray(score, np.float32)
    n = len(score)
    thumb = rng.uniform(-0.05, 0.05, (n, 3)) if thumb is None else np.asarray(thumb)
    thumb = thumb.astype(np.float32)
    valid = np.ones(n, bool) if valid is None else np.asarray(valid)
    down = np.tile(np.float32([0, 0, -1]), (n, 1))
    along = np.tile(np.float32([0.015, 0, 0]), (n, 1))
    centre = thumb + np.float32(0.06) * down
    return Heatmap(
        vertices=thumb,
        normals=-down,
        score=score,
        score_without_com=np.sqrt(score),
        thumb=thumb,
        opposing=centre,
        long_axis=along / np.float32(0.015),
        offset=np.full(n, 0.015, np.float32),
        wrap=np.stack([centre + along, centre - along], axis=1),
        wrap_normals=np.stack([down, down], axis=1),
        centre=centre,
        axis=down,
        width=np.full(n, 0.06, np.float32),
        valid=valid,
        terms={name: rng.uniform(0, 1, n).astype(np.float32) for name in TERMS},
    )

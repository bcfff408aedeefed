"""What the viewer shows for an anchor: pure, so that it is tested without a browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike

from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.heatmap.sampling import Triples, sample_triples
from mjx_grasp.heatmap.steering import SIGMA_M, Heatmap, Steering, contact_sigma, steer_to
from mjx_grasp.records.settings import Finite, NonNegative, Positive, Range, Settings

MOST_TRIPLES = 8
TripleCount = Annotated[int, Range(1, MOST_TRIPLES)]


@dataclass(frozen=True)
class ViewerSettings(Settings):
    """What a user sets in the viewer."""

    anchor: tuple[Finite, Finite, Finite] | None = None
    """in the object frame; None for the default heatmap [m]"""
    size: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    """of the part around the anchor, 0 of a point [m]"""
    sigma: Positive | None = None
    """distance from the anchor at which a score falls to 1/e; that of `steer_to` if None [m]"""
    steering: Steering = "contacts"
    """what has to be near the anchor"""
    triples: TripleCount = 3
    """how many of the best triples are drawn [-]"""
    to_best: bool = True
    """whether the yellow end of the scale is the best score, else 1"""

    @property
    def scale(self) -> float:
        """Sigma, set or by default [m]."""
        if self.sigma is not None:
            return self.sigma
        return (
            float(contact_sigma(np.asarray(self.size))) if self.steering == "contacts" else SIGMA_M
        )


@dataclass(frozen=True, eq=False)
class Shown:
    """What is shown; arrays are NumPy's, object frame."""

    score: Float[np.ndarray, " v"]
    colours: UInt8[np.ndarray, "v 3"]
    triples: Triples
    """the best first; see ``valid`` for those that exist"""

    @property
    def best(self) -> float:
        """The best score."""
        return float(self.score.max())

    def describe(self) -> str:
        """The best triple in words, for people and tests; millimetres."""
        if not self.triples.valid[0]:
            return "no grasp"
        thumb = _millimetres(self.triples.thumb[0])
        wraps = " and ".join(_millimetres(p) for p in self.triples.wrap[0])
        return f"score {self.best:.3f}, thumb {thumb}, index and middle {wraps} mm"


def show(heatmap: Heatmap, settings: ViewerSettings, min_distance: float = 0.02) -> Shown:
    """What the viewer shows.

    Args:
        heatmap: Candidates, one per vertex.
        settings: What the user has set.
        min_distance: How far apart the drawn triples are [m].
    """
    score = heatmap.score
    if settings.anchor is not None:
        place = jnp.asarray(settings.anchor), jnp.asarray(settings.size)
        score = steer_to(heatmap, *place, settings.sigma, settings.steering)
    drawn = sample_triples(
        jax.random.key(0), heatmap, settings.triples, score,
        temperature=0.0, min_distance=min_distance, min_score=0.0,
    )  # fmt: skip
    values = np.asarray(score)
    best = float(values.max())
    top = best if settings.to_best and best > 0 else 1.0
    shown = np.where(np.asarray(heatmap.valid), values, np.nan)
    triples: Triples = jax.tree.map(np.asarray, drawn)
    return Shown(values, score_colours(shown, top), triples)


def _millimetres(point: ArrayLike) -> str:
    # The sum with 0 turns a negative zero into a positive one.
    return "({:.1f}, {:.1f}, {:.1f})".format(*(np.round(1e3 * np.asarray(point), 1) + 0.0))

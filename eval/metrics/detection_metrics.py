"""Agreement of the detected particles with the truly attached ones, on the estimator's mesh.

PCD ("percentage of correct detections") is precision and PUG ("percentage of uncovered ground truth") is recall, as
defined in Shinde, Liang et al., RSS 2024 (arXiv 2405.09743), section on estimation; both are fractions here. There the
truth is dilated for PCD and the estimate for PUG, one mesh ring per step ("dilation is implemented with graph
convolution on simulation meshes").

What is undefined is None, never 0 or 1: PCD without detections, PUG without attachments, F1 without either. With
exactly one of the two sets empty F1 is 0, by 2 TP / (2 TP + FP + FN). On a tissue without attachments the figure to
read is the number of detections.

The truth comes already transferred to the particles (`truth_transfer`); nothing here knows of stiffness.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

DILATIONS = (0, 1, 2)
"""Rings of dilation that are reported, as in the paper."""
GATE_VARIANCE = 0.1
"""Variance gate of the paper: particles of larger variance are left out [N^2/m^2]."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Detections against truth at one dilation; fractions in [0, 1], None where undefined."""

    pcd: float | None
    """Precision: share of the detected that is attached."""
    pug: float | None
    """Recall: share of the attached that is detected."""
    f1: float | None
    """Harmonic mean of PCD and PUG."""


@dataclass(frozen=True, kw_only=True)
class Distances:
    """Distances from each point of one set to the nearest of the other, at rest [m]; None where either set is empty."""

    mean: float | None
    percentile_95: float | None


def edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Return the mesh's edges, each once, the smaller vertex first."""
    return np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)


def dilate(chosen: Bool[np.ndarray, " n"], faces: Int[np.ndarray, "f 3"], rings: int) -> Bool[np.ndarray, " n"]:
    """Return `chosen` and every vertex within `rings` edges of it."""
    pairs, grown = edges(faces), chosen.copy()
    for _ in range(rings):
        touched = grown[pairs].any(axis=1)
        grown = grown.copy()
        grown[pairs[touched].ravel()] = True
    return grown


def patches(chosen: Bool[np.ndarray, " n"], faces: Int[np.ndarray, "f 3"]) -> list[Int[np.ndarray, " m"]]:
    """Return the chosen vertices in groups connected by edges between chosen ones, the largest group first."""
    pairs = edges(faces)
    pairs = pairs[chosen[pairs].all(axis=1)]
    n = len(chosen)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    groups = [np.flatnonzero(chosen & (label == value)) for value in np.unique(label[chosen])]
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def agreement(
    detected: Bool[np.ndarray, " n"],
    attached: Bool[np.ndarray, " n"],
    faces: Int[np.ndarray, "f 3"],
    rings: int,
    *,
    certain: Bool[np.ndarray, " n"] | None = None,
    observable: Bool[np.ndarray, " n"] | None = None,
) -> Agreement:
    """Return PCD, PUG and F1 after `rings` rings of dilation.

        PCD = |D & dilate(T)| / |D|,   PUG = |T & dilate(D)| / |T|

    Args:
        detected: D.
        attached: T.
        faces: the estimator's mesh.
        rings: steps of dilation.
        certain: particles that pass the variance gate; the others are dropped from D and from the T that PUG counts.
            They stay in the truth that a detection may hit.
        observable: the part of T that PUG counts, all of it if None.
    """
    counted = np.ones_like(attached) if certain is None else certain
    found = detected & counted
    wanted = attached & counted if observable is None else attached & counted & observable
    pcd = _share(found & dilate(attached, faces, rings), found)
    pug = _share(wanted & dilate(found, faces, rings), wanted)
    if pcd is None and pug is None:
        return Agreement(pcd=None, pug=None, f1=None)
    total = (pcd or 0.0) + (pug or 0.0)
    return Agreement(pcd=pcd, pug=pug, f1=2 * (pcd or 0.0) * (pug or 0.0) / total if total else 0.0)


def average_precision(score: Float[np.ndarray, " n"], attached: Bool[np.ndarray, " n"]) -> float | None:
    """Return the area under the precision-recall steps, AP = sum_k (R_k - R_{k-1}) P_k.

    The sum is over the distinct scores, highest first. Particles of equal score enter together. It is
    None without attachments.
    """
    if not attached.any():
        return None
    order = np.argsort(-score, kind="stable")
    last_of_tie = np.append(np.diff(score[order]) != 0, True)
    hits = np.cumsum(attached[order])[last_of_tie]
    precision = hits / (np.flatnonzero(last_of_tie) + 1)
    return float(np.sum(np.diff(hits, prepend=0) * precision) / attached.sum())


def distances(origin: Float[np.ndarray, "a 3"], target: Float[np.ndarray, "b 3"]) -> Distances:
    """Return mean and 95th percentile of the distance from each origin to its nearest target [m]."""
    if not len(origin) or not len(target):
        return Distances(mean=None, percentile_95=None)
    each = KDTree(target).query(origin)[0]
    return Distances(mean=float(each.mean()), percentile_95=float(np.percentile(each, 95)))


def _share(part: Bool[np.ndarray, " n"], whole: Bool[np.ndarray, " n"]) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None

"""Effects that close-loop found in several recordings of one sheet, side by side, and whether their sizes agree.

With sizes x_i ± s_i of K recordings, m = Σ w_i x_i / Σ w_i and w_i = 1 / s_i², the sum Q = Σ w_i (x_i - m)² has a
chi-square distribution of K - 1 degrees of freedom if all recordings have the same size [Cochran 1954, Biometrics
10:101].
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

MIN_P_VALUE = 0.05
"""P-value from which sizes agree, over all parameters of an effect together."""


@dataclass(frozen=True, kw_only=True)
class CommonSize:
    """Size of one parameter in several recordings together."""

    mean: float
    """Mean, each size weighted by its precision."""
    sd: float
    """Standard deviation of the mean."""
    p_value: float
    """Probability of sizes that differ as much or more, if all recordings have the same."""


def common_size(sizes: Sequence[float], sds: Sequence[float]) -> CommonSize | None:
    """Return the size that recordings have in common; None for fewer than two, or without a finite sd above 0.

    Args:
        sizes: one for each recording.
        sds: standard deviations of the sizes.
    """
    x, s = np.asarray(sizes, dtype=float), np.asarray(sds, dtype=float)
    if len(x) < 2 or not (np.isfinite(x).all() and np.isfinite(s).all() and (s > 0).all()):
        return None
    weights = s**-2.0
    mean = float(weights @ x / weights.sum())
    p_value = float(chi2.sf(weights @ (x - mean) ** 2, len(x) - 1))
    return CommonSize(mean=mean, sd=float(weights.sum() ** -0.5), p_value=p_value)


def effects_compared(
    found: Mapping[str, Mapping[str, Any]], *, same_at_sites: Collection[str] = ()
) -> list[dict[str, Any]]:
    """Return each effect that was added in a recording, with its size in each of them and whether these agree.

    Args:
        found: content of discrepancy.json by the recording's name.
        same_at_sites: effects whose parameters mean the same at each of their sites.
    """
    added: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
    for recording, one in found.items():
        for effect in one["effects"]:
            added.setdefault(effect["name"], []).append((recording, effect))
    return [_compared(name, those, found, same_at_sites) for name, those in added.items()]


def _compared(
    name: str,
    added: list[tuple[str, Mapping[str, Any]]],
    found: Mapping[str, Mapping[str, Any]],
    same_at_sites: Collection[str],
) -> dict[str, Any]:
    sites = {effect["site"] for _, effect in added}
    comparable = len(sites) == 1 or name in same_at_sites
    sizes, sds = (zip(*(effect[key] for _, effect in added), strict=True) for key in ("theta", "sd"))
    common = [common_size(*each) for each in zip(sizes, sds, strict=True)] if comparable else []
    known = [one for one in common if one is not None]
    p_value = min(1.0, len(known) * min(one.p_value for one in known)) if known and len(known) == len(common) else None
    return {
        "name": name,
        "units": added[0][1]["units"],
        "this_session_alone": added[0][1]["this_session_alone"],
        "found": [
            {"recording": recording} | {key: effect[key] for key in ("site", "theta", "sd")}
            for recording, effect in added
        ],
        "ambiguous_in": [recording for recording, one in found.items() if name in one["ambiguous_with"]],
        "same_site": comparable,
        "mean": None if p_value is None else [one.mean for one in known],
        "mean_sd": None if p_value is None else [one.sd for one in known],
        "p_value": p_value,
        "agree": None if p_value is None else p_value >= MIN_P_VALUE,
    }

"""The fits of a closed loop as a file, `fits.npz`, from which `close-loop --joint` goes on.

Its array `about` is a text in JSON: the effects that were looked for, and of each hypothesis what is small. The other
arrays have an entry for each hypothesis and each of its two fits.
"""

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.estimator.attribution.joint_evidence import OwnInformation, SharedPrior
from jiggle_mj.estimator.attribution.joint_hypotheses import EffectsPrior, RecordedFit
from jiggle_mj.estimator.attribution.kept_fits import KeptFit, KeptLoop, KeptPoint
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales
from jiggle_mj.recording.npz_arrays import read_npz
from jiggle_mj.recording.output_files import write_bytes

FITS = "fits.npz"
"""Name of the file."""
ENDS = ("assumed", "likeliest")
"""The two fits of a hypothesis."""
POINT = ("theta", "s", "states")
"""Arrays of a point."""


def write_fits(path: Path, kept: KeptLoop) -> None:
    """Write the fits of a closed loop.

    Raises:
        OutputError: the file cannot be written.
    """
    about = {
        "n_parts": kept.n_parts,
        "sites": dict(kept.prior.sites),
        "of_tissue": [
            {"effect": effect, "sd": one.sd.tolist(), "lower": [low if np.isfinite(low) else None for low in one.lower]}
            for effect, one in kept.prior.of_tissue.items()
        ],
        "scores": [{"effect": effect, "score": score} for effect, score in kept.scores.items()],
        "fits": [_about(one) for one in kept.fits],
    }
    arrays = {
        name: np.array([[getattr(getattr(one, end), name) for end in ENDS] for one in kept.fits]) for name in POINT
    }
    data = io.BytesIO()
    np.savez(data, allow_pickle=False, about=np.array(json.dumps(about)), rest=kept.rest, **arrays)
    write_bytes(path, data.getvalue())


def read_fits(path: Path) -> KeptLoop:
    """Return the fits of a closed loop.

    Raises:
        OutputError: the file is missing or damaged.
    """
    try:
        arrays = read_npz(path.read_bytes())
        about = json.loads(str(arrays["about"]))
        prior = EffectsPrior(
            sites=about["sites"],
            of_tissue={
                _sited(one["effect"]): SharedPrior(
                    sd=np.array(one["sd"]), lower=np.array([-np.inf if low is None else low for low in one["lower"]])
                )
                for one in about["of_tissue"]
            },
        )
        return KeptLoop(
            rest=arrays["rest"],
            n_parts=about["n_parts"],
            prior=prior,
            scores={_sited(one["effect"]): one["score"] for one in about["scores"]},
            fits=[_fit(one, {name: arrays[name][k] for name in POINT}) for k, one in enumerate(about["fits"])],
        )
    except (OSError, RecordingError, LookupError, TypeError, ValueError) as failure:
        raise OutputError(
            f"{path} cannot be read ({failure}); close-loop of several recordings writes it: delete its folder, and it "
            "is made anew."
        ) from failure


def _about(one: KeptFit) -> dict[str, Any]:
    recorded, known = one.recorded, one.recorded.information
    return {
        "shared": recorded.shared,
        "own": recorded.own,
        "larger_errors": recorded.larger_errors,
        "log_evidence": known.log_evidence if np.isfinite(known.log_evidence) else None,
        "theta": known.theta.tolist(),
        "precision": known.precision.tolist(),
        "slope": known.slope.tolist(),
        "scales": [asdict(getattr(one, end).scales) for end in ENDS],
    }


def _fit(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> KeptFit:
    shared, own = (tuple(map(_sited, about[key])) for key in ("shared", "own"))
    size = len(about["theta"])
    information = OwnInformation(
        log_evidence=-np.inf if about["log_evidence"] is None else about["log_evidence"],
        theta=np.array(about["theta"], dtype=float),
        precision=np.reshape(np.array(about["precision"], dtype=float), (size, size)),
        slope=np.array(about["slope"], dtype=float),
    )
    ends = {
        end: KeptPoint(scales=NoiseScales(**about_end), **{name: arrays[name][k] for name in POINT})
        for k, (end, about_end) in enumerate(zip(ENDS, about["scales"], strict=True))
    }
    return KeptFit(
        effects=tuple(sorted((*shared, *own))),
        recorded=RecordedFit(shared=shared, own=own, larger_errors=about["larger_errors"], information=information),
        **ends,
    )


def _sited(pair: list[Any]) -> tuple[str, int]:
    name, site = pair
    return name, site

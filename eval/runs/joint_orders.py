"""What is done with one recording when several are fitted together: sets of effects that others found, and fixed sizes.

Each follows the recording again, with the settings with which the loop was closed over it, and goes on from its fits.
Its lines go to the end of the recording's log.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import jax
import numpy as np

from jiggle_mj.estimator.attribution.dataset import Dataset, collect_dataset
from jiggle_mj.estimator.attribution.hypotheses import Log
from jiggle_mj.estimator.attribution.joint_fits import FixedFit, fit_sets, with_fixed
from jiggle_mj.estimator.attribution.joint_hypotheses import Effects, Sited
from jiggle_mj.estimator.attribution.kept_fits import KeptFit
from jiggle_mj.estimator.blas import one_thread

from .closing_order import LOG, ClosingOrder
from .compiled_functions import drop_many_compiled
from .kept_files import FITS, read_fits


@dataclass(frozen=True, kw_only=True)
class FitSets:
    """Sets of shared effects to fit to a recording that lacks them."""

    order: ClosingOrder
    """The recording, after the loop was closed over it."""
    wanted: Sequence[Effects]
    """The sets."""
    sizes: Mapping[Sited, np.ndarray]
    """Parameters of effects in other recordings, at which a fit may begin."""

    def execute(self) -> list[KeptFit]:
        """Return the fits.

        Raises:
            JiggleError: what following the recording raises.
        """
        kept = read_fits(self.order.folder / FITS)
        with _followed(self.order) as (dataset, log):
            return fit_sets(dataset, self.order.options["library"], kept, self.wanted, self.sizes, log)


@dataclass(frozen=True, kw_only=True)
class FixSizes:
    """Fits of a recording with sizes of the shared effects that hold for all."""

    order: ClosingOrder
    """The recording, after the loop was closed over it."""
    fixed: Sequence[tuple[KeptFit, np.ndarray]]
    """Fits to begin from, each with the parameters of its shared effects."""

    def execute(self) -> list[FixedFit]:
        """Return the fits.

        Raises:
            JiggleError: what following the recording raises.
        """
        with _followed(self.order) as (dataset, log):
            return [with_fixed(dataset, self.order.options["library"], one, theta, log) for one, theta in self.fixed]


Order = FitSets | FixSizes


def execute(order: Order) -> list[KeptFit] | list[FixedFit]:
    """Return what an order says; a function that other processes can be sent."""
    return order.execute()


@contextmanager
def _followed(order: ClosingOrder) -> Iterator[tuple[Dataset, Log]]:
    """Follow a recording as before, with double precision and a log until the end of the context."""
    drop_many_compiled()
    recording, declaration = order.opened()
    config, mask = order.options["config"], order.options["mask"]
    dataset = collect_dataset(declaration, recording.camera, recording, config=config, mask=mask)
    with open(order.folder / LOG, "a", encoding="utf-8") as file, jax.enable_x64(True), one_thread():
        yield dataset, lambda text: print(text, file=file, flush=True)
